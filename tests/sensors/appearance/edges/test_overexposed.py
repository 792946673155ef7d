"""White pixels: a level that they clip is a lower bound, and says so."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import chi2

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer
from rendezview.sensors.appearance.edges.grey import off_white
from rendezview.sensors.appearance.edges.measured import MeasuredEdges, nothing_known
from rendezview.sensors.appearance.edges.predicted import COLUMNS, FOUND, NX, STATE, WEIGHT, U, V
from rendezview.sensors.appearance.edges.profile_fit import fit_clipped_profile, fit_profile
from rendezview.sensors.appearance.edges.profile_levels import mark_clipped, read_profile
from rendezview.sensors.appearance.model.view_tables import ProjectedEdge

ZERO, SIGMA, NOISE, SKY = 10, 0.85, 1.0, 12.0
PIXELS = np.arange(21.0) - ZERO
CAMERA = Camera.from_fov(400, 400, np.deg2rad(40.0))


def clipped_step(place: float, height: float) -> np.ndarray:
    return np.minimum(SKY + height * ndtr((place - PIXELS) / SIGMA), 255.0)


def placed(profile: np.ndarray, start: float, clipped: np.ndarray | None) -> tuple[float, float]:
    depths, levels, result = np.zeros(1), np.array([243.0]), np.zeros(2)
    rest = (21, ZERO, start, depths, levels, 1, SKY, True, SIGMA, NOISE, result)
    if clipped is None:
        assert fit_profile(profile, *rest)
    else:
        assert fit_clipped_profile(profile, clipped, *rest)
    return result[0], result[1]


def steepest(profile: np.ndarray) -> float:
    slope = profile[:-1] - profile[1:]
    return float(PIXELS[np.argmax(slope)] + 0.5)


def edge_at(u: float, v: float, nx: float, ny: float) -> ProjectedEdge:
    return ProjectedEdge(True, u, v, nx, ny, nx, ny, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("over", [2.0, 3.0, 5.0])
def test_a_clipped_step_is_placed_nearer_to_its_place_than_as_a_whole_one(over):
    """Whole, it lies 0.35 to 0.76 px outside."""
    off, outside = [], []
    for place in np.linspace(-0.45, 0.45, 7):
        profile = clipped_step(place, over * 243.0)
        start = steepest(profile)
        bounded, variance = placed(profile, start, profile >= 254.0)
        outside.append(placed(profile, start, None)[0] - place)
        off.append(bounded - place)
        assert abs(bounded - place) < 0.25
        assert 0.0 < variance < 0.25
    assert abs(np.mean(off)) < 0.4 * np.mean(outside)


def test_a_step_that_white_just_does_not_clip_is_placed_exactly():
    profile = clipped_step(0.3, 243.0)
    assert placed(profile, 0.5, np.zeros(21, dtype=bool))[0] == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("over", [2.0, 3.0, 6.0])
def test_the_steepest_slope_before_a_white_surface_is_moved_towards_its_edge(over):
    """In the mean over places; a mirrored profile, white outside, is moved the other way."""
    moved, left = [], []
    for place in np.linspace(-0.5, 0.5, 11):
        profile = clipped_step(place, over * 243.0)
        at = steepest(profile)
        found = off_white(profile, 21, ZERO, at, SIGMA)
        assert off_white(profile[::-1].copy(), 21, ZERO, -at, SIGMA) == pytest.approx(-found)
        moved.append(found - place)
        left.append(at - place)
    assert abs(np.mean(moved)) < abs(np.mean(left))
    assert off_white(np.minimum(profile, 250.0), 21, ZERO, at, SIGMA) == at


def test_the_levels_of_a_profile_that_white_pixels_take_part_in_are_marked():
    rng = np.random.default_rng(3)
    image = rng.choice([40, 200, 255], (60, 60), p=[0.3, 0.5, 0.2]).astype(np.uint8)
    some = 0
    for _ in range(40):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        edge = edge_at(*rng.uniform(25.0, 35.0, 2), np.cos(angle), np.sin(angle))
        profile, clipped = np.zeros(21), np.ones(21, dtype=bool)
        assert read_profile(image, edge.u, edge.v, edge.nx, edge.ny, ZERO, 10, 3, profile)
        found = mark_clipped(image, edge, ZERO, 0.4, 21, 3, profile, clipped)
        # The white pixels alone, read in the same way, are the share of white of each level.
        share = np.zeros(21)
        white = np.where(image >= 254, 100, 0).astype(np.uint8)
        assert read_profile(white, edge.u, edge.v, edge.nx, edge.ny, ZERO, 10, 3, share)
        expected = (share > 10.0) & (profile >= 127.0) & (abs(PIXELS) <= 5)
        sure = abs(share - 10.0) > 1e-6
        np.testing.assert_array_equal(clipped[sure], expected[sure])
        assert found == clipped.any()
        some += clipped.sum()
    assert some > 50


def test_edges_that_are_off_together_move_the_pose_as_a_step_onto_them_does():
    rng = np.random.default_rng(5)
    rows = np.zeros((40, COLUMNS))
    rows[:, :6], rows[:, WEIGHT], rows[:, STATE] = rng.normal(size=(40, 6)), 1.0, FOUND
    rows[:, [U, V]], rows[:, NX] = rng.uniform(5.0, 55.0, (40, 2)).round(), 1.0
    edges = MeasuredEdges.of(rows, 3.0, np.eye(3), np.array([0.0, 0.0, 5.0]))
    image = rng.choice([0, 255], (60, 60)).astype(np.uint8)
    white = edges.beside_white(image)
    column, row = rows[:, U].astype(int) - 2, rows[:, V].astype(int)
    np.testing.assert_array_equal(white, image[row, column] == 255)
    move = np.linalg.lstsq(edges.pose_slopes, 0.3 * white, rcond=None)[0]
    found = edges.off_together(1e-9 * nothing_known(1.0), np.zeros(3), 0.3 * white)
    np.testing.assert_allclose(found, np.outer(move, move), atol=1e-9)


@pytest.fixture(scope="module")
def overexposed(refining_model, bumpy_mesh, draw) -> tuple[np.ndarray, np.ndarray]:
    """Of poses of a body at eight times white: the errors in range (share), and NEES."""
    recognizer = Recognizer(refining_model, CAMERA, trees=False)
    rng = np.random.default_rng(11)
    short, nees = [], []
    for _ in range(12):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        depth = refining_model.target_radius_m * rng.uniform(5.0, 8.0)
        truth = Pose(rotation, np.array([0.02, -0.03, 1.0]) * depth)
        frame = draw(bumpy_mesh, truth, CAMERA, rng, bright_grey=8.0 * 243.0)
        found = recognizer.recognize(frame, truth)
        assert found.pose is not None
        short.append(found.pose.translation_m[2] / depth - 1.0)
        error = truth.delta_from(found.pose)
        nees.append(error @ np.linalg.solve(found.covariance, error))
    return np.array(short), np.array(nees)


def test_an_overexposed_body_is_not_taken_for_a_nearer_one(overexposed):
    """As a whole profile of eight times white its outline lies 1 px outside, 2.3 % of the range."""
    short, _ = overexposed
    assert abs(np.median(short)) < 0.006


def test_the_covariance_of_an_overexposed_body_holds_its_errors(overexposed):
    _, nees = overexposed
    assert np.mean(nees) < 6.0 * 1.5
    assert np.max(nees) < chi2.isf(1e-4, 6)
