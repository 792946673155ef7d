"""Symmetries of a body whose axes pass beside the target's origin."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import (
    Symmetry,
    angle_between,
    common_point,
    discrete_turns,
    nearest_alike,
)

X, Y, Z = np.eye(3)
CENTRE = np.array([1.5, 1.0, 0.5])
CORNERS = np.array(list(itertools.product((0.0, 3.0), (0.0, 2.0), (0.0, 1.0))))  # of a box


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))


def turned_about(point_m: Array, rotation: Array) -> Pose:
    """target_from_target of a turn about a point."""
    return Pose(rotation, point_m - rotation @ point_m)


def sorted_rows(points: Array) -> Array:
    return np.array(sorted(np.round(points, 9).tolist()))


def test_poses_alike_put_the_corners_of_a_box_on_the_same_places() -> None:
    """The origin is a corner: its place changes, the set of all corners does not."""
    box = [Symmetry("discrete", axis, math.pi, CENTRE) for axis in (X, Y)]
    rng = np.random.default_rng(1)
    truth = random_pose(rng)
    assert len(discrete_turns(box)) == 4
    for turn in discrete_turns(box):
        estimate = truth @ turned_about(CENTRE, turn)
        assert sorted_rows(estimate.apply(CORNERS)) == pytest.approx(
            sorted_rows(truth.apply(CORNERS)), abs=1e-8
        )
        alike = nearest_alike(estimate, truth, box)
        np.testing.assert_allclose(alike.rotation, truth.rotation, atol=1e-12)
        np.testing.assert_allclose(alike.translation_m, truth.translation_m, atol=1e-12)
        assert angle_between(estimate, truth, box) == pytest.approx(0.0, abs=1e-7)


def test_an_alike_pose_keeps_the_error_of_the_centre() -> None:
    box = [Symmetry("discrete", Z, math.pi, CENTRE)]
    truth = random_pose(np.random.default_rng(2))
    shift_m = np.array([0.1, -0.2, 0.3])
    turned = truth @ turned_about(CENTRE, np.diag([-1.0, -1.0, 1.0]))
    alike = nearest_alike(Pose(turned.rotation, turned.translation_m + shift_m), truth, box)
    np.testing.assert_allclose(alike.translation_m - truth.translation_m, shift_m, atol=1e-12)


def test_any_turn_about_an_axis_beside_the_origin_is_undone() -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        round_body = [Symmetry("continuous", axis, None, CENTRE + rng.normal() * axis)]
        truth = random_pose(rng)
        spin = Rotation.from_rotvec(rng.uniform(-3.0, 3.0) * axis).as_matrix()
        alike = nearest_alike(truth @ turned_about(CENTRE, spin), truth, round_body)
        np.testing.assert_allclose(alike.rotation, truth.rotation, atol=1e-7)
        np.testing.assert_allclose(alike.translation_m, truth.translation_m, atol=1e-6)


def test_a_ball_keeps_its_centre_and_takes_any_attitude() -> None:
    ball = [Symmetry("continuous", axis, None, CENTRE) for axis in (X, Z)]
    rng = np.random.default_rng(4)
    truth, estimate = random_pose(rng), random_pose(rng)
    alike = nearest_alike(estimate, truth, ball)
    np.testing.assert_array_equal(alike.rotation, truth.rotation)
    np.testing.assert_allclose(alike.apply(CENTRE), estimate.apply(CENTRE), atol=1e-12)


def test_axes_given_by_different_points_meet_in_the_centre() -> None:
    axes = [
        Symmetry("discrete", Z, math.pi, np.array([1.5, 1.0, 0.0])),
        Symmetry("discrete", X, math.pi, np.array([0.0, 1.0, 0.5])),
    ]
    np.testing.assert_allclose(common_point(axes), CENTRE, atol=1e-12)
    np.testing.assert_array_equal(common_point([axes[0]]), axes[0].point_m)
    np.testing.assert_array_equal(common_point([]), np.zeros(3))


def test_axes_that_pass_each_other_are_no_symmetries_of_a_body() -> None:
    parallel = [Symmetry("discrete", Z, math.pi, point) for point in (np.zeros(3), X)]
    with pytest.raises(ValueError, match=r"no common point, they miss it by 0\.5 m"):
        nearest_alike(Pose.identity(), Pose.identity(), parallel)
    rounded = [Symmetry("discrete", Z, math.pi, CENTRE), Symmetry("discrete", X, math.pi, CENTRE)]
    nudged = [rounded[0], Symmetry("discrete", X, math.pi, np.round(CENTRE + 0.004, 2))]
    np.testing.assert_allclose(common_point(nudged), CENTRE, atol=0.01)


def test_a_record_without_a_point_is_about_the_origin() -> None:
    old = Symmetry.of_record({"kind": "discrete", "axis": [0.0, 0.0, 1.0], "angle_rad": math.pi})
    np.testing.assert_array_equal(old.point_m, np.zeros(3))
    assert "point_m" not in old.record()
    new = Symmetry.of_record(Symmetry("continuous", X, None, CENTRE).record())
    assert (new.kind, new.angle_rad) == ("continuous", None)
    np.testing.assert_array_equal(new.axis, X)
    np.testing.assert_array_equal(new.point_m, CENTRE)
    with pytest.raises(ValueError, match="reshape"):
        Symmetry.of_record(new.record() | {"point_m": [1.0, 2.0]})
