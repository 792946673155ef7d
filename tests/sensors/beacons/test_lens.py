"""Brown's lens, eq. 6: both directions, OpenCV's words for it, its derivatives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tests import plain_pictures as plain

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import Lens, LitDark, ReflectorSensor, RigCamera, Spots
from rendezview.sensors.beacons.detect.brown_lens import shift, unshift
from rendezview.sensors.beacons.detect.lens_scale import LensScale
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS, SIZE
from rendezview.sensors.beacons.detect.spots import SpotTable
from rendezview_ground.simulate.reflector_frames import ReflectorFrameOptions, render_pair

WHOLE = Lens((0.2, -0.1, 0.05), (0.004, -0.003, 2.0), (0.01, -0.02), corrects=True)
FIELD = np.random.default_rng(5).uniform(-0.3, 0.3, (200, 2))


def test_equation_6_as_printed():
    x, y = 0.2, -0.1
    l1, l2, l3, p1, p2, p3 = 0.3, -0.2, 0.1, 0.01, -0.02, 1.5
    r2 = x * x + y * y
    radial = l1 * r2 + l2 * r2**2 + l3 * r2**3
    dx = x * radial + (1 + p3 * r2) * (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y)
    dy = y * radial + (1 + p3 * r2) * (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)
    lens = Lens((l1, l2, l3), (p1, p2, p3))
    assert lens.undistort([[x, y]])[0] == pytest.approx([x + dx, y + dy], abs=1e-15)


@pytest.mark.parametrize("corrects", [True, False])
def test_distort_undoes_undistort(corrects: bool):
    lens = Lens(WHOLE.radial, WHOLE.tangential, WHOLE.centre, corrects)
    assert lens.distort(lens.undistort(FIELD)) == pytest.approx(FIELD, abs=1e-12)
    assert np.abs(lens.undistort(FIELD) - FIELD).max() > 1e-3


def test_opencvs_lens_is_the_same_lens():
    distortion = (-0.28, 0.09, 0.002, -0.001, 0.03)
    lens = Lens.from_opencv(distortion)
    rays = np.column_stack([FIELD, np.ones(len(FIELD))])
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))
    assert lens.distort(FIELD) == pytest.approx(seen.reshape(-1, 2), abs=1e-12)
    assert lens.to_opencv(0.3) == distortion


def test_a_lens_of_the_other_direction_is_refitted_within_the_tolerance():
    lens = Lens((0.05, 0.0, 0.0), (1e-4, -1e-4, 0.0), corrects=True)
    other = Lens.from_opencv(lens.to_opencv(0.25))
    inside = FIELD[np.abs(FIELD).max(axis=1) < 0.25]
    assert other.distort(inside) == pytest.approx(lens.distort(inside), abs=1e-5)


def test_what_opencv_cannot_say_is_refused():
    with pytest.raises(RendezviewError, match="p3"):
        WHOLE.to_opencv(0.3, 1e-7)
    with pytest.raises(RendezviewError, match="rational"):
        Lens.from_opencv((0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0))


@pytest.mark.parametrize("corrects", [True, False])
def test_derivatives_are_those_of_the_numbers(corrects: bool):
    lens = Lens(WHOLE.radial, WHOLE.tangential, WHOLE.centre, corrects)
    measured, by_place, by_coefficient = lens.derivatives(FIELD)
    assert measured == pytest.approx(lens.distort(FIELD), abs=1e-14)
    h = 1e-6
    for axis in range(2):
        step = np.eye(2)[axis] * h
        slope = (lens.distort(FIELD + step) - lens.distort(FIELD - step)) / (2 * h)
        assert by_place[:, :, axis] == pytest.approx(slope, abs=1e-8)
    for k in range(8):
        step = np.eye(8)[k] * h
        ahead, behind = (
            Lens.from_coefficients(lens.coefficients + s, corrects=corrects).distort(FIELD)
            for s in (step, -step)
        )
        assert by_coefficient[:, :, k] == pytest.approx((ahead - behind) / (2 * h), abs=1e-8)


@pytest.mark.parametrize("corrects", [True, False])
def test_sigma_follows_the_lens(corrects: bool):
    rng = np.random.default_rng(3)
    lens = Lens((0.8, 0.0, 0.0), (0.01, 0.02, 0.0), corrects=corrects)
    at, sigma = np.array([0.25, -0.2]), np.array([1e-4, 3e-4])
    scattered = lens.undistort(at + rng.normal(0.0, sigma, (20_000, 2)))
    camera = RigCamera("one", 1.0, 1.0, 0.0, 0.0, Pose.identity(), lens, size=(1, 1))
    place, told = camera.ideal(Spots(at[None], sigma[None], [0]))
    assert place[0] == pytest.approx(scattered.mean(axis=0), abs=2e-5)
    assert told[0] == pytest.approx(scattered.std(axis=0), rel=0.03)


def test_a_point_beyond_the_fold_is_nan():
    lens = Lens((-1.0, 0.0, 0.0), corrects=False)
    assert np.isnan(lens.undistort([[2.0, 0.0]])).all()


def delta(points: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Eq. 6 by plain numpy, (N, 2) → (N, 2); complex numbers too, for derivatives."""
    x, y = (points - c[6:]).T
    r2 = x * x + y * y
    radial = c[0] * r2 + c[1] * r2**2 + c[2] * r2**3
    g = 1.0 + c[5] * r2
    return np.stack(
        [
            x * radial + g * (c[3] * (r2 + 2.0 * x * x) + 2.0 * c[4] * x * y),
            y * radial + g * (c[4] * (r2 + 2.0 * y * y) + 2.0 * c[3] * x * y),
        ],
        axis=1,
    )


def slopes(points: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(N, 2, 2) derivatives of Δ by the complex step."""
    return np.stack([delta(points + 1e-30j * a, c).imag / 1e-30 for a in np.eye(2)], axis=-1)


def test_newton_undoes_equation_6_and_gives_its_derivatives():
    c = WHOLE.coefficients
    solved = np.array([unshift(*(point + delta(point[None], c)[0]), c) for point in FIELD])
    np.testing.assert_allclose(solved[:, :2], FIELD, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(solved[:, 2:], slopes(FIELD, c).reshape(-1, 4), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("corrects", [True, False])
def test_a_spot_becomes_an_ideal_place_as_in_numpy(corrects: bool):
    rng = np.random.default_rng(6)
    c, k = WHOLE.coefficients, np.array([800.0, 750.0, 320.0, 250.0, 0.07])
    ideal = FIELD
    by_place = np.eye(2) + slopes(FIELD, c)
    if corrects:  # Δ leads from the measured to the ideal place
        measured, ideal = FIELD, FIELD + delta(FIELD, c)
    else:
        measured, by_place = FIELD + delta(FIELD, c), np.linalg.inv(by_place)
    sigma = rng.uniform(0.05, 0.2, FIELD.shape)
    spread = np.hypot(sigma, k[4]) / k[:2]
    twin = np.hstack([ideal, np.sqrt(((by_place * spread[:, None]) ** 2).sum(axis=-1))])
    spots = measured * k[:2] + k[2:4]
    lens = Lens.from_coefficients(c, corrects=corrects)
    camera = RigCamera("one", *k[:4], Pose.identity(), lens, size=(640, 480), floor=k[4])
    places = np.hstack(camera.ideal(Spots(spots, sigma, np.arange(len(spots)))))
    np.testing.assert_allclose(places, twin, rtol=1e-12, atol=1e-12)


def test_the_shift_of_the_compiled_loops_has_the_derivatives_of_equation_6():
    row = np.array([0.2, -0.1, 0.05, 0.004, -0.003, 2.0, 0.01, -0.02, 1.0])
    lens, h = Lens(tuple(row[:3]), tuple(row[3:6]), tuple(row[6:8]), corrects=True), 1e-6
    for x, y in FIELD[:20]:
        moved = [
            lens.undistort([[x + dx, y + dy]])[0] - (x + dx, y + dy)
            for dx, dy in ((0, 0), (h, 0), (-h, 0), (0, h), (0, -h))
        ]
        by_x, by_y = (moved[1] - moved[2]) / (2 * h), (moved[3] - moved[4]) / (2 * h)
        expected = [*moved[0], by_x[0], by_y[0], by_x[1], by_y[1]]
        assert shift(x, y, row) == pytest.approx(expected, abs=1e-9)


WIDE = Camera(640, 480, 330.0, 330.0, 319.5, 239.5, (-0.28, 0.07, 0.001, -0.001, 0.0))


def test_small_discs_are_scaled_by_the_slope_of_the_lens():
    scale = LensScale(WIDE, 0.75)
    places = np.array([[319.5, 239.5], [60.0, 50.0], [600.0, 240.0], [400.0, 430.0]])
    rays = WIDE.rays(places)
    for place, ray, found in zip(places, rays, scale.at(places), strict=True):
        angle = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
        ring = ray + 1e-4 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(400)])
        off = WIDE.project(ring) - place
        assert found == pytest.approx(np.sqrt((off**2).sum(axis=1).mean()) / 0.033, rel=4e-3)
    assert scale.at(places)[1] < 0.8  # a corner of a wide lens
    assert np.isnan(scale.at(np.array([[np.nan, 3.0]]))).all()
    assert (LensScale(WIDE.pinhole, 0.75).at(places) == 1.0).all()
    spots = SpotTable(np.zeros((1, COLUMNS)))
    spots.table[0, :2], spots.table[0, SIZE] = (60.0, 50.0), 3.0
    straight = scale.straightened(spots).table
    expected = np.array([[60.0, 50.0, straight[0, SIZE]]])
    scale.distort(expected)
    assert straight[0, SIZE] > 3.5
    assert expected[0, 2] == pytest.approx(3.0)


def test_dots_22_degrees_off_the_boresight_of_a_wide_lens_are_found_and_of_the_right_size(three):
    found = []
    for k in range(4):
        rng = np.random.default_rng(k)
        corner = np.array([210.0, 170.0]) + rng.uniform(-15, 15, 2)
        sight = WIDE.rays(corner[None])[0]
        sight /= np.linalg.norm(sight)
        aim = plain.turn(np.cross([0, 0, 1.0], sight), np.arccos(sight[2]))
        lean = Pose.identity().perturbed([*rng.normal(0.0, 0.15, 3), 0, 0, 0]).rotation
        pose = Pose(aim @ lean @ np.diag([1.0, -1.0, -1.0]), sight)
        frames = LitDark(*render_pair(WIDE, three, pose, ReflectorFrameOptions(), rng))
        sensor = ReflectorSensor(WIDE, [three])
        reading = [sensor.update(0.1 * t, frames) for t in range(4)][-1]
        assert reading.note is None
        found.append(reading.pose is not None and reading.pose.angle_to(pose) < 0.02)
    assert sum(found) == 4  # one without the scale of the lens
