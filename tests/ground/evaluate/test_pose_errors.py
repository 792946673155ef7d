"""Error measures by construction."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, nearest_alike
from rendezview_ground.evaluate.pose_errors import (
    SPEED_PLUS_ROTATION_RAD,
    SPEED_PLUS_TRANSLATION,
    pose_errors,
    speed_terms,
)

X, Y, Z = np.eye(3)


def turned(axis: Array, angle_rad: float) -> Array:
    return np.asarray(Rotation.from_rotvec(np.asarray(axis) * angle_rad).as_matrix())


def random_pose(rng: np.random.Generator) -> Pose:
    bearing = np.array([*rng.uniform(-0.3, 0.3, 2), 1.0])
    return Pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(5.0, 50.0) * bearing)


def about(pose: Pose, centre_m: Array, rotation: Array) -> Pose:
    """The target turned by a rotation of camera axes about a point that stays."""
    turned_rotation = rotation @ pose.rotation
    return Pose(turned_rotation, pose.apply(centre_m) - turned_rotation @ centre_m)


def test_the_truth_itself_has_no_error() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose = random_pose(rng)
        errors = pose_errors(pose, pose, centre_m=rng.normal(size=3))
        for value in (
            errors.rotation_rad,
            errors.direction_rad,
            errors.roll_rad,
            errors.translation_m,
            errors.range_fraction,
            errors.bearing_rad,
            errors.speed_score,
        ):
            assert value == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("angle_deg", [0.01, 3.0, 90.0, 179.0])
def test_a_turn_about_the_line_of_sight_is_all_roll(angle_deg: float) -> None:
    rng = np.random.default_rng(2)
    centre, pose, angle = rng.normal(size=3), random_pose(rng), np.deg2rad(angle_deg)
    sight = pose.apply(centre) / np.linalg.norm(pose.apply(centre))
    errors = pose_errors(pose, about(pose, centre, turned(sight, angle)), centre_m=centre)
    assert errors.roll_rad == pytest.approx(angle, abs=1e-9)
    assert errors.rotation_rad == pytest.approx(angle, abs=1e-9)
    assert errors.direction_rad == pytest.approx(0.0, abs=1e-7)
    assert errors.bearing_rad == pytest.approx(0.0, abs=1e-9)
    assert errors.range_fraction == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("angle_deg", [0.01, 3.0, 90.0, 179.0])
def test_a_turn_across_the_line_of_sight_is_all_view_direction(angle_deg: float) -> None:
    rng = np.random.default_rng(3)
    centre, pose, angle = rng.normal(size=3), random_pose(rng), np.deg2rad(angle_deg)
    across = np.cross(pose.apply(centre), rng.normal(size=3))
    across /= np.linalg.norm(across)
    errors = pose_errors(pose, about(pose, centre, turned(across, angle)), centre_m=centre)
    assert errors.direction_rad == pytest.approx(angle, abs=1e-9)
    assert errors.rotation_rad == pytest.approx(angle, abs=1e-9)
    assert errors.roll_rad == pytest.approx(0.0, abs=1e-7)


def test_turning_the_camera_is_a_bearing_error_and_neither_direction_nor_roll() -> None:
    pose = Pose(turned(X, 0.4), np.array([0.0, 0.0, 20.0]))
    errors = pose_errors(pose, Pose(turned(Y, 0.1), np.zeros(3)) @ pose)
    assert errors.bearing_rad == pytest.approx(0.1)
    assert errors.rotation_rad == pytest.approx(0.1)
    assert errors.direction_rad == pytest.approx(0.0, abs=1e-9)
    assert errors.roll_rad == pytest.approx(0.0, abs=1e-9)
    assert errors.translation_m == pytest.approx(2.0 * 20.0 * math.sin(0.05))


def test_a_target_a_tenth_farther_has_a_range_error_of_a_tenth() -> None:
    pose = Pose(turned(Y, 2.0), np.array([3.0, -4.0, 12.0]))
    errors = pose_errors(pose, Pose(pose.rotation, 1.1 * pose.translation_m))
    assert errors.range_fraction == pytest.approx(0.1)
    assert errors.translation_m == pytest.approx(1.3)
    assert errors.bearing_rad == pytest.approx(0.0, abs=1e-9)
    assert errors.speed_translation == pytest.approx(0.1)
    assert errors.speed_score == pytest.approx(0.1, abs=1e-7)


def test_speed_plus_forgives_below_its_thresholds_and_nothing_above() -> None:
    assert math.degrees(SPEED_PLUS_ROTATION_RAD) == pytest.approx(0.169)
    assert SPEED_PLUS_TRANSLATION == 2.173e-3
    low, high = 0.99, 1.01
    r, t = SPEED_PLUS_ROTATION_RAD, SPEED_PLUS_TRANSLATION
    assert speed_terms(low * r, low * t, speed_plus=True) == (0.0, 0.0)
    assert speed_terms(high * r, low * t, speed_plus=True) == (high * r, 0.0)
    assert speed_terms(low * r, high * t, speed_plus=True) == (0.0, high * t)
    assert speed_terms(low * r, low * t) == (low * r, low * t)


def test_a_discrete_symmetry_leaves_what_it_does_not_explain() -> None:
    fourfold = Symmetry("discrete", Z, math.pi / 2)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    for angle, left in (
        (0.2, 0.2),
        (math.pi / 2 + 0.2, 0.2),
        (-math.pi / 2 - 0.2, 0.2),
        (0.9, 0.671),
    ):
        estimate = pose @ Pose(turned(Z, angle), np.zeros(3))
        errors = pose_errors(pose, estimate, symmetries=[fourfold])
        assert errors.rotation_rad == pytest.approx(left, abs=1e-3)


def test_a_continuous_symmetry_leaves_the_least_angle_of_a_fine_search() -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        truth, estimate = random_pose(rng), random_pose(rng)
        alike = nearest_alike(estimate, truth, [Symmetry("continuous", axis, None)])
        spins = Rotation.from_rotvec(np.linspace(0.0, 2.0 * np.pi, 1441)[:, None] * axis)
        left = Rotation.from_matrix(truth.rotation.T @ estimate.rotation) * spins
        searched = float(left.magnitude().min())
        assert alike.angle_to(truth) <= searched + 1e-9
        assert alike.angle_to(truth) == pytest.approx(searched, abs=3e-3)
        # still the same target: only turned about its axis
        np.testing.assert_allclose(alike.rotation @ axis, estimate.rotation @ axis, atol=1e-12)


def test_a_cylinder_that_can_be_flipped_forgives_both() -> None:
    cylinder = [Symmetry("continuous", Z, None), Symmetry("discrete", X, math.pi)]
    pose = Pose(turned(Y, 1.0), np.array([0.0, 1.0, 9.0]))
    estimate = pose @ Pose(turned(Z, 1.3) @ turned(X, math.pi) @ turned(Z, -0.4), np.zeros(3))
    assert pose_errors(pose, estimate, symmetries=cylinder).rotation_rad == pytest.approx(
        0.0, abs=1e-7
    )
    tilted = pose @ Pose(turned(X, 0.3), np.zeros(3))
    assert pose_errors(pose, tilted, symmetries=cylinder).rotation_rad == pytest.approx(0.3)


def test_a_turn_about_an_axis_beside_the_origin_moves_the_origin_and_is_no_error() -> None:
    corner = np.array([1.5, 1.0, 0.5])
    box = [Symmetry("discrete", axis, math.pi, corner) for axis in (X, Y)]
    pose = Pose(turned(Y, 0.4), np.array([0.0, 1.0, 9.0]))
    half_turn = turned(Z, math.pi)  # the product of both
    estimate = pose @ Pose(half_turn, corner - half_turn @ corner)
    assert pose_errors(pose, estimate).translation_m > 3.0
    errors = pose_errors(pose, estimate, symmetries=box, centre_m=corner)
    assert errors.rotation_rad == pytest.approx(0.0, abs=1e-7)
    assert errors.translation_m == pytest.approx(0.0, abs=1e-9)
    assert errors.range_fraction == pytest.approx(0.0, abs=1e-12)


def test_an_estimate_without_a_direction_is_as_wrong_as_can_be() -> None:
    truth = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    errors = pose_errors(truth, Pose.identity())
    assert errors.direction_rad == errors.bearing_rad == errors.roll_rad == math.pi
    assert errors.range_fraction == 1.0
    with pytest.raises(ValueError, match="camera's own centre"):
        pose_errors(Pose.identity(), truth)
