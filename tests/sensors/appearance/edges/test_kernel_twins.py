"""Compiled loops beside plain numpy: the same numbers on random input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.appearance.edges.alignment import normal_equations
from rendezview.sensors.appearance.edges.grey import (
    measure_edges,
    strongest_edge,
    unfitted_weight,
)
from rendezview.sensors.appearance.edges.lighting import ROUNDS, facing_normals, light_strengths
from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    NX,
    NY,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
    U,
    V,
    edge_of_row,
    predict_edges,
)
from rendezview.sensors.appearance.edges.profile import (
    expected_profile,
    profile_scratch,
    view_at_pose,
)
from rendezview.sensors.appearance.edges.profile_fit import fit_profile
from rendezview.sensors.appearance.edges.profile_levels import read_profile
from rendezview.sensors.appearance.model.contours import (
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    SURFACES,
    packed_start,
)
from rendezview.sensors.appearance.model.view_tables import (
    ViewTables,
    read_only,
)
from rendezview.sensors.appearance.search.starts import second_moments

CAMERA = Camera(400, 300, 520.0, 530.0, 199.0, 151.0, (-0.2, 0.1, 0.001, -0.002, 0.0))
RADIUS_M = 2.0


def measured(rng: np.random.Generator, count: int = 60) -> np.ndarray:
    """Measurements as ``measure_edges`` makes them, some without an edge."""
    edges = np.zeros((count, COLUMNS))
    edges[:, :6] = rng.normal(size=(count, 6)) * [50.0, 50.0, 50.0, 20.0, 20.0, 5.0]
    edges[:, RESIDUAL] = rng.normal(size=count)
    edges[:, WEIGHT] = rng.uniform(0.1, 1.0, count)
    edges[:, STATE] = np.where(rng.random(count) < 0.8, FOUND, OUTSIDE)
    return edges


def weighted(edges: np.ndarray, cut: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobians, residuals and Tukey's weights of the edges that count."""
    used = edges[(edges[:, STATE] == FOUND) & (np.abs(edges[:, RESIDUAL]) < cut)]
    residual = used[:, RESIDUAL]
    return used[:, :6], residual, used[:, WEIGHT] * (1.0 - (residual / cut) ** 2) ** 2


def shift_of(arm: np.ndarray) -> np.ndarray:
    shift = np.eye(6)
    shift[3:, :3] = np.array(
        [[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]]
    )
    return shift


def test_normal_equations():
    edges = measured(np.random.default_rng(1))
    matrix, right = np.empty((6, 6)), np.empty(6)
    used, weights = normal_equations(edges, 1.5, matrix, right)
    jacobian, residual, w = weighted(edges, 1.5)
    assert used == len(w)
    assert weights == pytest.approx(w.sum(), rel=1e-12)
    assert matrix == pytest.approx(jacobian.T * w @ jacobian, rel=1e-10, abs=1e-9)
    assert right == pytest.approx(jacobian.T @ (w * residual), rel=1e-10, abs=1e-9)


def test_covariance_of_independent_edges():
    rng = np.random.default_rng(2)
    edges, arm, loose = measured(rng), rng.normal(size=3), np.full(6, 1e-3)
    known = MeasuredEdges.of(edges, 1.5, np.eye(3), np.zeros(3))
    spread_px = known.residual_rms_px
    found = known.covariance(loose, arm) * spread_px**2
    jacobian, residual, w = weighted(edges, 1.5)
    rms = np.sqrt(np.sum(w * residual**2) / (np.sum(w) + 1e-12))
    bread = np.linalg.inv(jacobian.T * w @ jacobian + np.diag(loose))
    meat = jacobian.T * w**2 @ jacobian + np.diag(loose)
    expected = shift_of(arm) @ bread @ meat @ bread @ shift_of(arm).T * rms**2
    assert spread_px == pytest.approx(rms, rel=1e-12)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)


def tables(rng: np.random.Generator, count: int) -> ViewTables:
    """One view of random points on a sphere, random tangents."""
    point = rng.normal(size=(count, 3))
    point *= 0.9 / POINT_UNIT / np.linalg.norm(point, axis=1, keepdims=True)
    kind = np.full((1, 1, count + 2), OUTLINE, np.uint8)
    kind[..., count:] = NO_POINT
    padded = np.zeros((1, 1, count + 2, 3), np.int16)
    padded[0, 0, :count] = np.rint(point)
    tangent = np.zeros((1, 1, count + 2, 3), np.int8)
    tangent[0, 0, :count] = rng.integers(-127, 128, (count, 3))
    arrays = (
        np.array([[0.0, 0.0, -1.0]]), np.array([9.0]), padded, tangent, kind,
        np.full((1, 1, count + 2, 2), 255, np.uint8),
        np.zeros((1, 1, count + 2, SURFACES), np.uint8),
        np.zeros((1, 1, count + 2, SURFACES - 1, 2), np.int8),
        np.zeros((256, 4), np.float32),
    )  # fmt: skip
    return ViewTables(*map(read_only, arrays), RADIUS_M, 0.85, 0.0)


@pytest.mark.parametrize("bent", [False, True])
def test_points_normals_and_derivatives_are_those_of_the_projected_contour(bent):
    rng = np.random.default_rng(4)
    camera = CAMERA if bent else Camera(400, 300, 520.0, 530.0, 199.0, 151.0)
    count = 40
    views = tables(rng, count)
    rotation = np.ascontiguousarray(Rotation.random(random_state=rng).as_matrix())
    centre = np.array([0.2, -0.1, 12.0])
    image = rng.integers(0, 255, (300, 400)).astype(np.uint8)
    out = np.zeros((count + 2, COLUMNS))
    total = measure_edges(
        image, (lens_vector(camera), camera.is_distorted), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        views, 0, 0, rotation, centre, np.zeros(256), np.zeros(3), 6, 3.0, 1, 0.0, 1, 1, False, out,
    )  # fmt: skip
    assert total == count
    assert np.all(out[count:, STATE] == OUTSIDE)

    def pixel(turn: np.ndarray, move: np.ndarray, along: float = 0.0) -> np.ndarray:
        unit_m = RADIUS_M * POINT_UNIT
        points = views.point[0, 0, :count] * unit_m + along * views.tangent[0, 0, :count]
        moved = points @ rotation.T @ Rotation.from_rotvec(turn).as_matrix().T
        return camera.project(moved + centre + move)

    still = np.zeros(3)
    assert out[:count, [U, V]] == pytest.approx(pixel(still, still), abs=1e-9)
    h = 1e-6
    edge = pixel(still, still, h) - pixel(still, still, -h)
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert out[:count, [NX, NY]] == pytest.approx(normal, abs=1e-4 if bent else 1e-7)
    found = np.flatnonzero(out[:count, STATE] == FOUND)
    assert len(found) > 10
    for a in range(6):
        step = h * np.eye(3)[a % 3]
        turn, move = (step, still) if a < 3 else (still, step)
        rate = (pixel(turn, move) - pixel(-turn, -move)) / (2.0 * h)
        expected = np.sum(rate * out[:count, [NX, NY]], axis=1)
        assert out[found, a] == pytest.approx(expected[found], rel=1e-3 if bent else 1e-5, abs=0.05)


def test_a_profile_is_the_mean_of_parallel_lines_read_bilinearly():
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    u, v, back, ahead = 37.3, 28.8, 7, 9
    nx, ny = np.cos(0.7), np.sin(0.7)
    profile = np.zeros(112)
    assert read_profile(image, u, v, nx, ny, back, ahead, 3, profile)
    lines = []
    for shift in (-1.5, 0.0, 1.5):
        t = np.arange(-back, ahead + 1)
        a, b = u + t * nx - shift * ny, v + t * ny + shift * nx
        i, j = np.floor(b).astype(int), np.floor(a).astype(int)
        fb, fa = b - i, a - j
        grey = image.astype(float)
        lines.append(
            (1 - fb) * ((1 - fa) * grey[i, j] + fa * grey[i, j + 1])
            + fb * ((1 - fa) * grey[i + 1, j] + fa * grey[i + 1, j + 1])
        )
    assert profile[: back + ahead + 1] == pytest.approx(np.mean(lines, axis=0), abs=1e-9)
    assert not read_profile(image, 5.0, v, -1.0, 0.0, back, ahead, 3, profile)


@pytest.mark.parametrize("smooth_px", [1, 2, 4])
@pytest.mark.parametrize("held", [False, True])
def test_the_strongest_edge_is_the_extreme_slope_of_the_best_score(smooth_px, held):
    rng = np.random.default_rng(6)
    back, spread_px, needed, sky, noise = 14, 5.0, 4.0, 60.0, 2.0
    for _ in range(40):
        profile = np.cumsum(rng.normal(0.0, 12.0, 29)) + 90.0
        at, steepness = strongest_edge(
            profile, len(profile), back, smooth_px, spread_px, needed, held, sky, noise
        )
        places = range(smooth_px - 1, len(profile) - smooth_px)
        slopes = np.array(
            [
                np.sum(profile[i + 1 : i + 1 + smooth_px] - profile[i + 1 - smooth_px : i + 1])
                for i in places
            ]
        ) / smooth_px  # fmt: skip
        best = (0.0, 0.0, 0.0)
        for k in range(1, len(slopes) - 1):
            before, size, after = np.abs(slopes[k - 1 : k + 2])
            i = smooth_px + k  # of the loop: one step after the candidate
            if not (size >= needed and size >= before and size > after):
                continue
            beyond = profile[min(i + 1 + smooth_px, len(profile) - 1)]
            if held and not (slopes[k] < 0.0 and beyond < sky + max(3.5 * noise, 0.4 * size)):
                continue
            place = i - 0.5 - back
            score = (size / (size + 60.0)) ** 2 * np.exp(-0.5 * (place / spread_px) ** 2)
            if score > best[0]:
                bend = before - 2.0 * size + after
                best = (score, place + 0.5 * (before - after) / bend, size)
        assert (at, steepness) == pytest.approx(best[1:], rel=1e-9, abs=1e-9)


def test_weights_of_edges_at_the_steepest_slope():
    assert unfitted_weight(12.0, 9.0, True, False) == pytest.approx(0.5)
    assert unfitted_weight(12.0, 9.0, False, False) == pytest.approx(0.15)
    assert unfitted_weight(12.0, 9.0, True, True) == pytest.approx(0.05)
    assert unfitted_weight(12.0, 2.5, True, False) == pytest.approx(0.25)


@pytest.mark.parametrize("held", [False, True])
def test_the_profile_fit_is_dense_least_squares_with_prior_knowledge(held):
    """Gauss–Newton on place, gain, tilt and background; Φ in the loop is a table to 1e-6."""
    rng = np.random.default_rng(7)
    depths, levels = np.array([0.0, 0.9, 2.2]), np.array([120.0, -70.0, 30.0])
    sigma, noise, zero = 0.85, 1.2, 10
    pixels = np.arange(21) - zero
    for _ in range(30):
        truth, start = rng.uniform(-0.4, 0.4, 2)
        profile = 14.0 + 1.1 * ndtr((truth - pixels[:, None] - depths) / sigma) @ levels
        profile += rng.normal(0.0, noise, 21)
        result = np.zeros(2)
        fits = fit_profile(
            profile, 21, zero, start, depths, levels, 3, 12.0, held, sigma, noise, result
        )
        x = np.array([start, 1.0, 0.0, 12.0])
        for step in range(4):
            first, last = int(np.ceil(x[0] - 3.2)) + zero, int(np.floor(x[0] + 2.7)) + zero
            d = x[0] - pixels[first : last + 1]
            z = (d[:, None] - depths) / sigma
            shape, share = ndtr(z) @ levels, ndtr(d / sigma)
            slope = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi) @ levels
            rows = [x[1] * slope / sigma + x[2] * share, shape, d * share, np.ones_like(d)]
            jacobian = np.stack(rows, axis=1)
            r = profile[first : last + 1] - x[3] - x[1] * shape - x[2] * d * share
            normal, right = jacobian.T @ jacobian, jacobian.T @ r
            uncertain = 9.0 + noise**2
            known = np.array([uncertain / 0.25, uncertain / (0.1 * 120.0 + 1e-3) ** 2])
            normal[[1, 2], [1, 2]] += known
            right[1:3] += known * ([1.0, 0.0] - x[1:3])
            normal[3, 3] += 1e9 * held
            normal[0, 0] += 1e9 if step == 0 else 1e-6
            move = np.linalg.solve(normal, right)
            variance = np.linalg.inv(normal)[0, 0]
            x += np.clip(move, [-0.6, -np.inf, -np.inf, -np.inf], [0.6, np.inf, np.inf, np.inf])
            if step > 0 and abs(move[0]) < 0.02:
                break
        assert fits
        assert result[0] == pytest.approx(x[0], abs=1e-3)
        assert result[1] == pytest.approx((r @ r / (len(d) - 3) + noise**2) * variance, rel=0.02)


def test_the_light_is_that_of_reweighted_least_squares():
    rng = np.random.default_rng(8)
    albedo = rng.uniform(0.2, 0.9, 200)
    lit = albedo * rng.uniform(0.0, 1.0, 200)
    levels = 180.0 * lit + 20.0 * albedo + rng.normal(0.0, 6.0, 200)
    levels[:30] = 0.0
    strengths = np.empty(2)
    cost = light_strengths(levels, lit, albedo, 15.0, np.inf, strengths, ROUNDS, False)
    x = np.stack([lit, albedo], axis=1)
    weight, fitted = np.maximum(levels, 0.0), np.zeros(2)
    for _ in range(3):
        normal = x.T * weight @ x + 1e-9 * np.eye(2)
        normal[1, 1] *= 1.001
        fitted = np.linalg.solve(normal, x.T @ (weight * levels))
        assert np.all(fitted >= 0.0)
        weight = 1.0 / (1.0 + ((levels - x @ fitted) / 15.0) ** 2)
        total = np.sum(1.0 - weight)
        weight = weight**2
    assert strengths == pytest.approx(fitted, rel=1e-9)
    assert cost == pytest.approx(total, rel=1e-9)


def test_normals_face_the_camera():
    rng = np.random.default_rng(9)
    palette = rng.normal(size=(30, 4)).astype(np.float32)
    rotation = np.ascontiguousarray(Rotation.random(random_state=rng).as_matrix())
    away = np.array([0.1, 0.2, 0.97])
    normals = palette[:, :3].astype(float) @ rotation.T
    normals *= np.where(normals @ away > 0.0, -1.0, 1.0)[:, None]
    assert facing_normals(palette, rotation, away) == pytest.approx(normals, abs=1e-12)


def test_second_moments_leave_out_the_rows_without_a_point():
    rng = np.random.default_rng(10)
    points = rng.integers(-30000, 30000, (50, 3)).astype(np.int16)
    kinds = np.where(rng.random(50) < 0.3, NO_POINT, OUTLINE).astype(np.uint8)
    kept = points[kinds != NO_POINT].astype(float)
    assert second_moments(points, kinds) == pytest.approx(kept.T @ kept, rel=1e-15)


def test_the_expected_profile_at_the_models_own_view_has_the_stored_places():
    """An outline at (0, 0.5, 0) seen along z: surfaces of 100, 40, 40, 90, 90."""
    camera = Camera(400, 300, 500.0, 500.0, 199.0, 151.0)
    lens, centre, eye = (lens_vector(camera), False), np.array([0.0, 0.0, 10.0]), np.zeros(3)
    eye[2] = -10.0
    tangent = np.array([-127, 0, 0], np.int8)
    rows = np.zeros((1, COLUMNS))
    point, kept = read_only(np.array([[0, 500, 0]], np.int16)), read_only(tangent[None])
    predict_edges(point, kept, 1, 1, lens, 1e-3, np.eye(3), centre, rows)
    edge = edge_of_row(rows[0], 0.0, 0.5, 0.0, np.eye(3), centre)
    inside = np.array([0.03, 0.05, 0.06, 0.08])  # of the radius
    start = np.zeros((SURFACES - 1, 2), np.int8)
    start[:, 0] = np.rint(packed_start(inside))
    kept = start[:, 0].astype(float) ** 2 * 12.0 / 196.0 / 127.0**2
    body_px = RADIUS_M * 500.0 / 10.0
    shade = np.array([0.0, 100.0, 40.0, 90.0])
    sun, strip = np.zeros(3), np.array([1, 2, 2, 3, 3], np.uint8)
    view = view_at_pose(eye, RADIUS_M, np.eye(3), centre, sun, shade)
    scratch = profile_scratch()
    steps = expected_profile(
        0.0, 0.5, 0.0, tangent, edge, True, strip, start, body_px, view, scratch
    )
    assert steps == 3
    assert scratch.levels[:3] == pytest.approx([100.0, -60.0, 50.0])
    assert scratch.depths[:3] == pytest.approx(
        [0.0, kept[0] * body_px, kept[2] * body_px], abs=0.02
    )
    flat = view_at_pose(eye, RADIUS_M, np.eye(3), centre, sun, np.array([0.0, 3.0, 3.0, 3.0]))
    assert (
        expected_profile(0.0, 0.5, 0.0, tangent, edge, True, strip, start, body_px, flat, scratch)
        == 0
    )
