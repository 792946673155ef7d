"""A ring of unknown size: rectangle, laser range, R and D_f (Zhai et al.)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.sensors.ring.flyaround import DISTANCE_M, PANEL_M, RADIUS_M, camera_at

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.ring import Ellipse, shape_of_circle
from rendezview.sensors.ring.rectangle import rectangle_attitude, rectangle_pose
from rendezview.sensors.ring.ring_pass import ring_size_of_pass
from rendezview.sensors.ring.ring_size import RingSight, ring_size

CAMERA = Camera.from_fov(2048, 2048, np.radians(50.0))


def pose_at(angle, rng=None):
    pose = camera_at(angle)
    if rng is None:
        return pose
    return Pose(Rotation.from_rotvec(rng.normal(0.0, 0.03, 3)).as_matrix(), np.zeros(3)) @ pose


def sight(pose, corner_px, ellipse_px, range_m, rng):
    y, z = 0.5 * PANEL_M[0], 0.5 * PANEL_M[1]
    corners = CAMERA.project(pose.apply([[0, y, z], [0, -y, z], [0, y, -z], [0, -y, -z]]))
    axis = pose.rotation[:, 0]
    shape = shape_of_circle(CAMERA, pose.apply([DISTANCE_M, 0, 0]), axis, RADIUS_M)
    noise = np.eye(5) * max(ellipse_px, 1e-6) ** 2
    true = float(axis @ pose.translation_m) / axis[2]
    return RingSight(
        corners + rng.normal(0.0, corner_px, (4, 2)),
        Ellipse.from_shape(shape + rng.normal(0.0, ellipse_px, 5), noise),
        true + rng.normal(0.0, range_m), max(corner_px, 1e-6), max(range_m, 1e-9),
    )  # fmt: skip


def test_attitude_and_place_of_a_rectangle_are_exact_without_noise():
    rng = np.random.default_rng(0)
    for angle in np.linspace(-1.0, 1.0, 9):
        pose = pose_at(angle, rng)
        one = sight(pose, 0.0, 0.0, 0.0, rng)
        found, skew = rectangle_pose(CAMERA, one.corners_px, one.range_m)
        assert found.angle_to(pose) < 1e-8
        np.testing.assert_allclose(found.translation_m, pose.translation_m, atol=1e-7)
        assert abs(skew) < 1e-8


def test_noise_makes_the_sides_skew_and_the_attitude_stays_a_rotation():
    rng = np.random.default_rng(1)
    one = sight(pose_at(0.6), 1.0, 0.0, 0.0, rng)
    found = rectangle_attitude(CAMERA, one.corners_px)
    assert 1e-5 < abs(found.skew_rad) < 0.1
    np.testing.assert_allclose(found.rotation.T @ found.rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_corners_on_a_line_are_no_rectangle():
    assert rectangle_attitude(CAMERA, [[10, 10], [20, 20], [30, 30], [40, 40]]) is None
    with pytest.raises(ValueError, match="corners_px"):
        rectangle_attitude(CAMERA, [[10, 10]])


def test_radius_and_distance_are_exact_without_noise():
    rng = np.random.default_rng(2)
    for angle in (-0.9, -0.3, 0.4, 1.0):
        size = ring_size(CAMERA, sight(pose_at(angle, rng), 0.0, 0.0, 0.0, rng))
        assert size.radius_m == pytest.approx(RADIUS_M, rel=1e-6)
        assert size.distance_m == pytest.approx(DISTANCE_M, rel=1e-6)


def test_the_uncertainty_is_that_of_the_errors_and_a_pass_is_sharper():
    rng = np.random.default_rng(3)
    single, odd, whole, odd_whole = [], [], [], []
    for _ in range(6):
        sights = [sight(pose_at(a), 0.05, 0.02, 0.005, rng) for a in np.linspace(-1.0, 1.0, 25)]
        for one in sights:
            size = ring_size(CAMERA, one)
            error = np.array([size.radius_m - RADIUS_M, size.distance_m - DISTANCE_M])
            single.append(np.abs(error))
            odd.append(error @ np.linalg.solve(size.covariance, error) / 2.0)
        size = ring_size_of_pass(CAMERA, sights)
        error = np.array([size.radius_m - RADIUS_M, size.distance_m - DISTANCE_M])
        whole.append(np.abs(error))
        odd_whole.append(error @ np.linalg.solve(size.covariance[:2, :2], error) / 2.0)
    assert 0.7 < np.mean(odd) < 1.4
    assert np.mean(odd_whole) < 3.0
    assert (np.median(single, axis=0) < 0.01 * np.array([RADIUS_M, DISTANCE_M])).all()
    assert (np.max(whole, axis=0) < 0.002 * np.array([RADIUS_M, DISTANCE_M])).all()


def test_too_few_frames_make_no_pass():
    rng = np.random.default_rng(4)
    assert ring_size_of_pass(CAMERA, [sight(pose_at(0.5), 0.05, 0.02, 0.005, rng)] * 2) is None


def test_an_error_that_all_frames_share_is_not_lessened_by_their_number():
    sights = []
    rng = np.random.default_rng(7)
    for angle in np.linspace(-0.9, 0.9, 16):
        pose = pose_at(angle, rng)
        one = sight(pose, 0.0, 0.0, 0.0, np.random.default_rng(0))
        ellipse = Ellipse.from_shape(one.ellipse.shape, 1e-4 * np.eye(5))
        sights.append(RingSight(one.corners_px, ellipse, one.range_m, 0.01, 0.001))
    for count in (8, 16):
        plain, shared = (ring_size_of_pass(CAMERA, sights[:count], px) for px in (0.0, 0.1))
        more = np.sqrt(shared.covariance[0, 0] - plain.covariance[0, 0])
        depth_m = 12.0 - DISTANCE_M
        assert more == pytest.approx(0.1 * depth_m / CAMERA.fx, rel=0.1)
        assert shared.radius_m == pytest.approx(plain.radius_m)
        np.testing.assert_array_equal(shared.covariance[1:, 1:], plain.covariance[1:, 1:])
