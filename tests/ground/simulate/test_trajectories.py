"""Paths of the camera: where it is, where it looks, and the physics of the tumble."""

from __future__ import annotations

import math
from typing import Any, get_args

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose, rotation_angle
from rendezview_ground.simulate.trajectories import (
    TimedPose,
    TrajectoryKind,
    TrajectoryOptions,
    looking_at,
    torque_free,
    trajectory,
)

KINDS: tuple[TrajectoryKind, ...] = get_args(TrajectoryKind)
CENTRE_M = (1.0, -2.0, 0.5)  # not the CAD origin


def made(kind: TrajectoryKind, **options: Any) -> list[TimedPose]:
    return trajectory(kind, TrajectoryOptions(centre_m=CENTRE_M, **options))


def centres_m(poses: list[TimedPose]) -> Array:
    """(N, 3) of the point looked at, in the camera frame."""
    return np.array([pose.apply(CENTRE_M) for _, pose in poses])


def cameras_m(poses: list[TimedPose]) -> Array:
    """(N, 3) of the camera, in the target frame, from the point looked at."""
    return np.array([pose.inverse().translation_m for _, pose in poses]) - CENTRE_M


@pytest.mark.parametrize("kind", KINDS)
def test_times_rise_by_the_step_from_zero(kind: TrajectoryKind) -> None:
    poses = made(kind, frames=7, dt_s=0.5)
    np.testing.assert_allclose([time_s for time_s, _ in poses], 0.5 * np.arange(7))


@pytest.mark.parametrize("kind", KINDS)
def test_without_jitter_the_boresight_meets_the_centre(kind: TrajectoryKind) -> None:
    centres = centres_m(made(kind, frames=23, start_range_m=20.0))
    np.testing.assert_allclose(centres[:, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(centres[:, 2], 20.0, rtol=1e-2)  # hops add 0.05 %


@pytest.mark.parametrize("kind", ["circular", "spiral", "vbar", "flyaround"])
def test_the_picture_is_upright(kind: TrajectoryKind) -> None:
    for _, pose in made(kind, frames=23):
        assert pose.rotation[1, 2] < -0.5, "the target's +Z points up, against camera y"


@pytest.mark.parametrize("kind", ["spiral", "vbar"])
def test_the_range_goes_from_start_to_end(kind: TrajectoryKind) -> None:
    poses = made(kind, frames=41, start_range_m=50.0, end_range_m=10.0)
    ranges = np.linalg.norm(centres_m(poses), axis=1)
    np.testing.assert_allclose(ranges[[0, -1]], [50.0, 10.0], rtol=1e-9)
    assert (np.diff(ranges) < 0.0).all()


def test_a_circle_keeps_its_range_in_the_targets_xy_plane() -> None:
    cameras = cameras_m(made("circular", frames=37, start_range_m=15.0, turn_rad=math.pi))
    np.testing.assert_allclose(np.linalg.norm(cameras, axis=1), 15.0)
    np.testing.assert_allclose(cameras[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(cameras[0], [15.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(cameras[18], [0.0, 15.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(cameras[-1], [-15.0, 0.0, 0.0], atol=1e-9)


def test_a_vbar_approach_hops_back_to_its_axis_as_often_as_asked() -> None:
    axis = np.array([0.0, 3.0, 0.0])
    poses = made(
        "vbar", frames=301, start_range_m=40.0, end_range_m=5.0, hops=3, approach_axis=tuple(axis)
    )
    cameras = cameras_m(poses)
    np.testing.assert_allclose(cameras[:, 1], np.linspace(40.0, 5.0, 301))
    np.testing.assert_allclose(cameras[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(cameras[[0, 100, 200, 300], 2], 0.0, atol=1e-9)
    assert cameras[50, 2] == pytest.approx(0.03 * cameras[50, 1])
    assert (cameras[:, 2] >= -1e-9).all()


def test_a_flyaround_closes_in_a_plane_of_the_asked_inclination() -> None:
    poses = made("flyaround", frames=61, start_range_m=20.0, end_range_m=12.0, inclination_rad=0.6)
    cameras = cameras_m(poses)
    np.testing.assert_allclose(cameras[0], cameras[-1], atol=1e-9)
    np.testing.assert_allclose(cameras @ [0.0, -math.sin(0.6), math.cos(0.6)], 0.0, atol=1e-9)
    ranges = np.linalg.norm(cameras, axis=1)
    assert (ranges[0], ranges[30]) == pytest.approx((20.0, 12.0))


def test_a_tumble_conserves_angular_momentum_and_energy() -> None:
    inertia = np.array([1.0, 1.6, 2.0])
    turns, rates = torque_free(inertia, (0.02, 0.4, 0.05), np.linspace(0.0, 120.0, 400))
    momentum = np.einsum("nij,nj->ni", turns, inertia * rates)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (400, 1)), atol=1e-8)
    energy = (inertia * rates**2).sum(axis=1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    # Spun about its middle axis a body turns over (Dzhanibekov): not a mere steady spin.
    assert rates[:, 1].min() < -0.3


def test_the_angular_velocity_of_a_tumble_is_that_of_its_poses() -> None:
    dt_s, rate = 1e-3, (0.1, 0.4, -0.2)
    poses = made("tumble", frames=2, dt_s=dt_s, body_rate_rad_s=rate)
    # camera_from_body(t)ᵀ camera_from_body(t + dt) ≈ 1 + dt [ω]× in body axes
    step = (poses[0][1].rotation.T @ poses[1][1].rotation - np.eye(3)) / dt_s
    np.testing.assert_allclose([step[2, 1], step[0, 2], step[1, 0]], rate, atol=1e-3)


def test_an_axisymmetric_body_precesses_at_the_closed_form_rate() -> None:
    # I = (A, A, C): the cross rate turns in body axes at (C − A) / A · ω_z.
    times_s = np.linspace(0.0, 50.0, 200)
    _, rates = torque_free((2.0, 2.0, 1.2), (0.1, 0.0, 0.5), times_s)
    angle = (1.2 - 2.0) / 2.0 * 0.5 * times_s
    truth = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(200, 0.5)], axis=1)
    np.testing.assert_allclose(rates, truth, atol=1e-9)


def test_random_attitudes_are_uniform_on_so3() -> None:
    turns = np.array([pose.rotation for _, pose in made("random", frames=4000)])
    # Each axis is uniform on the sphere: zero mean, second moments 1/3.
    np.testing.assert_allclose(turns.mean(axis=0), 0.0, atol=0.04)
    np.testing.assert_allclose((turns**2).mean(axis=0), 1.0 / 3.0, atol=0.03)
    # Angle of a uniform rotation: density (1 − cos) / π, mean π/2 + 2/π.
    angles = [rotation_angle(turn) for turn in turns]
    assert np.mean(angles) == pytest.approx(math.pi / 2 + 2 / math.pi, abs=0.04)


def test_random_ranges_and_bearings_fill_what_was_asked() -> None:
    poses = made("random", frames=2000, start_range_m=10, end_range_m=40, bearing_max_rad=0.3)
    centres = centres_m(poses)
    ranges = np.linalg.norm(centres, axis=1)
    assert 10.0 <= ranges.min() < 10.2
    assert 39.8 < ranges.max() <= 40.0
    bearings = np.arccos(centres[:, 2] / ranges)
    assert 0.29 < bearings.max() <= 0.3 + 1e-9
    # Uniform over solid angle: half of the cone's caps lie within acos((1 + cos) / 2).
    assert np.median(bearings) == pytest.approx(math.acos((1 + math.cos(0.3)) / 2), abs=0.01)


def test_jitter_moves_the_target_in_the_picture_and_not_in_range() -> None:
    poses = made("circular", frames=3000, pointing_jitter_rad=0.02, start_range_m=20.0)
    centres = centres_m(poses)
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 20.0)
    np.testing.assert_allclose((centres[:, :2] / 20.0).std(axis=0), 0.02, rtol=0.05)


def test_roll_jitter_turns_the_picture_about_the_boresight() -> None:
    poses = made("circular", frames=2000, roll_jitter_rad=0.05, turn_rad=0.0)
    still = made("circular", frames=1, turn_rad=0.0)[0][1]
    turns = np.array([pose.rotation @ still.rotation.T for _, pose in poses])
    np.testing.assert_allclose(turns[:, 2, 2], 1.0, atol=1e-9)
    assert np.arctan2(turns[:, 1, 0], turns[:, 0, 0]).std() == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_path(kind: TrajectoryKind) -> None:
    first, again, other = (
        made(kind, frames=4, pointing_jitter_rad=0.01, seed=seed)[3][1] for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first.rotation, again.rotation)
    assert np.abs(first.rotation - other.rotation).max() > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_a_single_frame_is_a_path_too(kind: TrajectoryKind) -> None:
    ((time_s, pose),) = made(kind, frames=1)
    assert time_s == 0.0
    assert np.linalg.norm(pose.apply(CENTRE_M)) == pytest.approx(30.0)


def test_looking_at_puts_the_centre_ahead_and_up_upwards() -> None:
    pose = looking_at([0.0, -5.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(pose.apply([0.0, 0.0, 0.0]), [0.0, 0.0, 5.0])
    np.testing.assert_allclose(pose.apply([1.0, 0.0, 0.0]), [1.0, 0.0, 5.0])
    np.testing.assert_allclose(pose.apply([0.0, 0.0, 1.0]), [0.0, -1.0, 5.0])
    assert isinstance(pose, Pose)


def test_looking_along_up_is_a_value_error() -> None:
    with pytest.raises(ValueError, match="upwards"):
        looking_at([0.0, 0.0, 5.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])


def test_an_unknown_kind_is_refused_with_the_known_ones() -> None:
    with pytest.raises(RendezviewError, match="circular, spiral"):
        trajectory("zigzag")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["circular", "tumble"])
def test_an_end_range_is_refused_where_the_range_is_kept(kind: TrajectoryKind) -> None:
    with pytest.raises(RendezviewError, match="end range"):
        made(kind, end_range_m=10.0)


def test_stations_lie_in_their_cone_at_all_ranges_and_bearings() -> None:
    axis = np.array([-1.0, 0.5, 0.2])
    poses = made(
        "stations", frames=400, start_range_m=8.0, end_range_m=2.0, approach_axis=tuple(axis),
        off_axis_max_rad=0.3, bearing_max_rad=0.1,
    )  # fmt: skip
    places, centres = cameras_m(poses), centres_m(poses)
    ranges = np.linalg.norm(places, axis=1)
    off = np.arccos(places @ axis / np.linalg.norm(axis) / ranges)
    bearing = np.arctan2(np.linalg.norm(centres[:, :2], axis=1), centres[:, 2])
    for values, (low, high) in ((ranges, (2.0, 8.0)), (off, (0.0, 0.3)), (bearing, (0.0, 0.1))):
        assert low <= values.min()
        assert values.max() <= high + 1e-9
        assert np.ptp(values) > 0.8 * (high - low)
    # uniform over the solid angle: half of the places lie beyond half of 1 − cos
    assert np.mean(np.cos(off) < 0.5 + 0.5 * np.cos(0.3)) == pytest.approx(0.5, abs=0.08)
    assert np.abs(np.mean(places / ranges[:, None], axis=0) @ np.cross(axis, [0, 0, 1])) < 0.03
    ups = np.array([pose.rotation[:, 2] for _, pose in poses])  # the target's +Z
    rolls = np.arctan2(ups[:, 0], -ups[:, 1])
    assert 0.25 < np.abs(rolls).max() < 0.45  # 0.3, and what perspective adds
    assert np.array_equal(poses[7][1].rotation, made(
        "stations", frames=400, start_range_m=8.0, end_range_m=2.0, approach_axis=tuple(axis),
        off_axis_max_rad=0.3, bearing_max_rad=0.1,
    )[7][1].rotation)  # fmt: skip
