"""Circle poses: exact, both, and with a covariance that can be trusted head-on too."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.sensors.ring.plain_fit import geometric_fit

from rendezview.sensors.ring import (
    CirclePose,
    Ellipse,
    circle_poses,
    shape_of_circle,
    tangent_basis,
)
from rendezview.sensors.ring.choice import by_attitude
from rendezview.sensors.ring.concentric import fit_joint, joint_poses
from rendezview_ground.simulate.ring_frames import tilted_axis

NOISE = np.diag([0.003, 0.003, 0.004, 0.003, 0.004]) ** 2


def test_the_true_pose_is_one_of_the_two(ring_camera):
    rng = np.random.default_rng(0)
    for _ in range(500):
        centre = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(3, 20)])
        axis = tilted_axis(centre, rng.uniform(0.0, 1.2), rng.uniform(0, 2 * math.pi))
        shape = shape_of_circle(ring_camera, centre, axis, 0.6)
        poses = circle_poses(ring_camera, Ellipse.from_shape(shape), 0.6)
        assert len(poses) in (1, 2)
        off = [np.linalg.norm(p.centre_m - centre) + np.linalg.norm(p.axis - axis) for p in poses]
        assert min(off) < 1e-8
        for pose in poses:  # the other one has the same picture, and faces the camera too
            again = shape_of_circle(ring_camera, pose.centre_m, pose.axis, 0.6)
            np.testing.assert_allclose(again, shape, atol=1e-6)
            assert pose.axis @ pose.centre_m < 0.0


@pytest.mark.parametrize("tilt", [0.0, 0.005, 0.02, 0.1, 0.5])
def test_the_covariance_holds_at_every_tilt_and_head_on(ring_camera, tilt):
    rng = np.random.default_rng(1)
    centre = np.array([0.3, 0.2, 6.0])
    axis = tilted_axis(centre, tilt, 1.0)
    true, odd, off, spread = shape_of_circle(ring_camera, centre, axis, 0.6), [], [], []
    for _ in range(200):
        seen = Ellipse.from_shape(true + np.linalg.cholesky(NOISE) @ rng.normal(size=5), NOISE)
        poses = circle_poses(ring_camera, seen, 0.6, radius_share=0.0)
        pose = max(poses, key=lambda p: p.axis @ axis)
        turn = tangent_basis(pose.axis).T @ (axis - pose.axis)
        error = np.concatenate([centre - pose.centre_m, turn])
        odd.append(error @ np.linalg.solve(pose.covariance, error) / 5.0)
        off.append(turn @ turn)
        spread.append(np.trace(pose.covariance[3:, 3:]))
    assert 0.7 < np.mean(odd) < 1.8
    assert 0.6 < math.sqrt(np.mean(off) / np.mean(spread)) < 1.4


def test_the_radius_is_as_sure_as_it_is_said_to_be(ring_camera):
    shape = shape_of_circle(ring_camera, [0.0, 0.0, 6.0], [0.0, 0.6, -0.8], 0.6)
    seen = Ellipse.from_shape(shape, NOISE)
    sure, unsure = (circle_poses(ring_camera, seen, 0.6, radius_share=s)[0] for s in (0.0, 0.01))
    assert unsure.covariance[2, 2] - sure.covariance[2, 2] == pytest.approx(0.06**2, rel=1e-3)
    with pytest.raises(ValueError, match="radius_m"):
        circle_poses(ring_camera, seen, -1.0)


def test_tangent_basis_is_right_handed_and_follows_camera_x():
    rng = np.random.default_rng(2)
    for axis in [*rng.normal(size=(20, 3)), np.array([1.0, 0.0, 0.0])]:
        n = axis / np.linalg.norm(axis)
        frame = np.column_stack([tangent_basis(n), n])
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1.0)


def test_a_circle_about_the_camera_has_no_picture(ring_camera):
    assert shape_of_circle(ring_camera, [0.0, 0.0, 0.5], [1.0, 0.0, 0.0], 0.6) is None


def two_poses(camera, centre, axis, covariance=NOISE):
    shape = shape_of_circle(camera, centre, axis, 0.6)
    return circle_poses(camera, Ellipse.from_shape(shape, covariance), 0.6)


def right_one(poses, axis):
    return int(np.argmax([pose.axis @ axis for pose in poses]))


def test_prior_attitude_chooses_and_says_so(ring_camera):
    centre = np.array([0.5, 0.2, 6.0])
    axis = tilted_axis(centre, 0.6, 2.0)
    poses = two_poses(ring_camera, centre, axis)
    choice = by_attitude(poses, tilted_axis(centre, 0.5, 1.8))
    assert choice.index == right_one(poses, axis)
    assert "prior attitude" in choice.reason
    along = -centre / np.linalg.norm(centre)  # half-way between the two
    assert by_attitude(poses, along).index is None


def test_head_on_the_two_poses_are_taken_for_one(ring_camera):
    centre = np.array([0.0, 0.0, 6.0])
    choice = by_attitude(two_poses(ring_camera, centre, np.array([0.0, 0.0, -1.0])), [0, 0, -1])
    assert choice.index is not None
    assert "head-on" in choice.reason


def test_edges_of_one_plane_sharpen_the_pose_and_tell_the_tilts_sign(ring_camera):
    rng = np.random.default_rng(4)
    single, joint, signs = [], [], []
    arc = np.linspace(0.0, 2.0 * math.pi / 3.0, 150)
    for _ in range(20):
        centre = np.array([0.3, -0.2, 4.0])
        axis = tilted_axis(centre, rng.uniform(0.3, 0.9), rng.uniform(0, 6))
        angles = rng.uniform(0.0, 6.0) + arc
        round_it = np.column_stack([np.cos(angles), np.sin(angles)]) @ tangent_basis(axis).T
        ellipses = []
        for ratio in (1.0, 0.93, 0.85):
            seen = ring_camera.project(centre + 0.6 * ratio * round_it)
            ellipses.append(geometric_fit(seen + rng.normal(0.0, 0.05, seen.shape)))
        alone = circle_poses(ring_camera, ellipses[0], 0.6)
        poses, misfits = joint_poses(ring_camera, ellipses, 0.6)
        single.append(np.linalg.norm(alone[right_one(alone, axis)].centre_m - centre))
        joint.append(np.linalg.norm(poses[right_one(poses, axis)].centre_m - centre))
        signs.append(int(np.argmin(misfits)) == right_one(poses, axis))
    assert np.median(joint) < 0.7 * np.median(single)
    assert sum(signs) >= 19


def test_an_edge_of_another_circle_is_left_out(ring_camera):
    centre = np.array([0.3, -0.2, 4.0])
    axis = tilted_axis(centre, 0.5, 1.0)
    ring = Ellipse.from_shape(shape_of_circle(ring_camera, centre, axis, 0.6), NOISE)
    aside = np.add(centre, [0.05, 0.0, 0.1])
    other = Ellipse.from_shape(shape_of_circle(ring_camera, aside, axis, 0.5), NOISE)
    poses, misfits = joint_poses(ring_camera, [ring, other], 0.6)
    assert misfits == (0.0, 0.0)
    assert min(np.linalg.norm(pose.centre_m - centre) for pose in poses) < 1e-6


def test_a_joint_fit_that_cannot_be_says_none(ring_camera):
    centre = np.array([0.0, 0.0, 4.0])
    axis = tilted_axis(centre, 0.5, 1.0)
    ring = Ellipse.from_shape(shape_of_circle(ring_camera, centre, axis, 0.6), NOISE)
    behind = CirclePose(-centre, axis, 0.6)
    assert fit_joint(ring_camera, [ring, ring], behind) is None


def test_an_edge_that_is_not_determined_gives_no_joint_pose(ring_camera):
    centre = np.array([0.0, 0.0, 4.0])
    axis = tilted_axis(centre, 0.5, 1.0)
    shape = shape_of_circle(ring_camera, centre, axis, 0.6)
    ring, flat = (Ellipse.from_shape(shape, covariance) for covariance in (NOISE, 0.0 * NOISE))
    assert fit_joint(ring_camera, [ring, flat], CirclePose(centre, axis, 0.6)) is None
