"""Prediction and update: slopes, biases, consistency."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from rendezview.fusion import (
    BeamSurface,
    FilterState,
    FusionOptions,
    MotionOptions,
    PoseMeasurement,
    RangeMeasurement,
    Rejected,
    RingCandidate,
    RingMeasurement,
    SensorOptions,
    innovation,
    predict,
    update,
)
from rendezview.fusion.kernels import turned
from rendezview.fusion.models import expected
from rendezview.fusion.state import begin
from rendezview.geometry.pose import Pose

WHITE = SensorOptions(bias_share=0.0)
QUIET = FusionOptions(
    motion=MotionOptions(angular=0.0, linear=0.0, pointing=0.0),
    pose=WHITE,
    ring=WHITE,
    range=WHITE,
    ring_other_edge=0.0,
)


def moved(state: FilterState, step: np.ndarray) -> FilterState:
    return replace(
        state,
        rotation=turned(step[:3], state.rotation),
        translation_m=state.translation_m + step[3:6],
        extras=state.extras + np.concatenate([step[6:8], np.zeros(len(state.extras) - 2)]),
    )


def test_slopes_of_every_kind_are_the_derivatives(world):
    state = begin(world.pose(0.0), QUIET)
    state = replace(state, extras=np.concatenate([[0.05, 0.1], state.extras[2:]]))
    for measurement in world.kinds(0.0):
        here = expected(state, measurement, WHITE)
        columns = [0, 1, 2, 3, 4, 5, 12, 13]
        for k, column in enumerate(columns):
            step = np.zeros(8)
            step[k] = 1e-6
            ahead = expected(moved(state, step), measurement, WHITE).residual
            behind = expected(moved(state, -step), measurement, WHITE).residual
            slope = (behind - ahead) / 2e-6  # a residual falls where what is expected rises
            assert np.allclose(slope, here.slope[:, column], rtol=0.02, atol=0.02), column


def test_a_slope_of_a_slanting_beam_is_the_derivative(world):
    state = begin(world.pose(0.0), QUIET)
    surface = BeamSurface(np.array([0.2, 0.5, -0.3]), np.array([0.8, 0.6, 0.0]))
    measurement = RangeMeasurement(
        0.0,
        "laser",
        30.0,
        0.02,
        (surface,),
        np.array([0.4, -0.3, 0.1]),
        np.array([0.05, 0.02, 1.0]),
    )
    here = expected(state, measurement, WHITE)
    for k in range(6):
        step = np.zeros(8)
        step[k] = 1e-5
        ahead = expected(moved(state, step), measurement, WHITE).residual
        behind = expected(moved(state, -step), measurement, WHITE).residual
        assert (behind - ahead) / 2e-5 == pytest.approx(here.slope[:, k], abs=1e-6)


@pytest.mark.requirement("RV-FUSE-3")
def test_normalised_errors_are_those_of_their_degrees_of_freedom(make_world):
    values = []
    for seed in range(60):
        world = make_world(seed)
        options = replace(QUIET, motion=replace(QUIET.motion, first_rate=0.003, first_velocity=0.3))
        world_turn = world.rng.normal(0.0, 0.003, 3) - world.turn
        world_move = world.rng.normal(0.0, 0.3, 3) - world.move

        def truth(time_s, world=world, turn=world_turn, move=world_move, still=world.truth):
            pose = still(time_s)
            extra = Rotation.from_rotvec((turn + world.turn) * time_s).as_matrix()
            return Pose(extra @ world.start.rotation, pose.translation_m + move * time_s)

        world.truth = truth
        state = begin(world.pose(0.0), options)
        for k in range(1, 8):
            state = predict(state, 1.0, options)
            for measurement in world.kinds(float(k)):
                found = innovation(state, replace(measurement, time_s=state.time_s), options)
                state = found.updated
        off = world.error(state.pose, truth(7.0))
        values.append(off @ np.linalg.solve(state.covariance[:6, :6], off))
    total = sum(values)
    assert chdtri(360, 0.999) < total < chdtri(360, 0.001)


def test_a_bias_is_not_averaged_away(world):
    bias = FusionOptions(
        motion=MotionOptions(angular=0.0, linear=0.0, pointing=0.0),
        pose=SensorOptions(bias_share=0.9, bias_s=1e9, bias_range=1e9),
    )
    state = begin(world.pose(0.0), bias)
    frozen = world.pose(0.0)
    for _ in range(1, 100):
        state = predict(state, 0.01, bias)
        state = innovation(state, replace(frozen, time_s=state.time_s), bias).updated
    sigma = np.sqrt(np.diag(state.covariance)[:6])
    assert np.all(sigma > 0.9 * np.sqrt(0.9) * world.sigma)
    white = begin(world.pose(0.0), QUIET)
    for _ in range(1, 100):
        white = predict(white, 0.01, QUIET)
        white = innovation(white, replace(frozen, time_s=white.time_s), QUIET).updated
    assert np.all(np.sqrt(np.diag(white.covariance)[:6]) < 0.5 * world.sigma)


def test_two_sensors_with_biases_share_the_weight(world):
    options = FusionOptions(pose=SensorOptions(bias_share=0.9))
    state = begin(world.pose(0.0), options)
    one = np.sqrt(np.diag(state.covariance)[:6])
    both = innovation(state, world.pose(0.0, sensor="stereo"), options).updated
    assert np.allclose(np.sqrt(np.diag(both.covariance)[:6]), one / np.sqrt(2.0), rtol=1e-6)


def test_an_unknown_radius_and_depth_of_the_ring_are_found(make_world):
    world = make_world(5)
    options = replace(QUIET, ring_radius_sigma=0.1, ring_depth_sigma_m=0.5)
    told = replace(
        world.ring_of_target,
        centre_m=world.ring_of_target.centre_m - 0.25 * world.ring_of_target.axis,
    )  # the ring is 0.25 m further
    state = begin(world.pose(0.0), options)
    for _ in range(1, 200):
        state = predict(state, 0.5, options)
        ring = world.ring(state.time_s, 0.003, 1e-3)
        one = ring.candidates[0]
        small = RingCandidate(
            one.centre_m / 1.04, one.axis, one.covariance
        )  # true radius: 4 % more
        for measurement in (
            world.pose(state.time_s),
            RingMeasurement(state.time_s, "ring", (small,), told),
        ):
            state = innovation(state, measurement, options).updated
    sigma = np.sqrt(np.diag(state.covariance)[12:14])
    assert state.extras[0] == pytest.approx(0.04, abs=4.0 * sigma[0])
    assert state.extras[1] == pytest.approx(0.25, abs=4.0 * sigma[1])
    assert sigma[0] < 0.004
    assert sigma[1] < 0.05


def test_of_two_circles_the_one_that_is_expected_counts(world):
    state = begin(world.pose(0.0), QUIET)
    true = world.ring(0.0)
    good = true.candidates[0]
    tilted = Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix() @ good.axis
    wrong = RingCandidate(good.centre_m, tilted, good.covariance)
    for candidates in ((good, wrong), (wrong, good)):
        both = innovation(state, replace(true, candidates=candidates), QUIET)
        alone = innovation(state, true, QUIET)
        assert both.nis == pytest.approx(alone.nis, rel=1e-6)
        assert np.allclose(both.updated.rotation, alone.updated.rotation, atol=1e-9)


def test_a_wrong_edge_counts_for_its_bearing_only(world):
    options = replace(QUIET, ring_other_edge=0.1)
    state = begin(world.pose(0.0), options)
    true = world.ring(0.0)
    one = true.candidates[0]
    inner = replace(one, centre_m=1.07 * one.centre_m)  # 7 % smaller, taken for the ring
    found = innovation(state, replace(true, candidates=(inner,)), options)
    assert found.loose
    assert found.nis < 10.0
    off_m = found.updated.translation_m - state.translation_m
    assert abs(off_m[2]) < 0.01
    assert not innovation(state, true, options).loose
    beside = replace(one, centre_m=one.centre_m + np.array([3.0, 0.0, 0.0]))
    assert innovation(state, replace(true, candidates=(beside,)), options).nis > 40.0


def test_two_circles_as_likely_turn_nothing_and_say_that_they_do_not_know(world):
    state = begin(world.pose(0.0), QUIET)
    axis = state.rotation @ world.ring_of_target.axis
    centre = state.pose.apply(world.ring_of_target.centre_m)
    covariance = world.ring(0.0).candidates[0].covariance
    pair = tuple(
        RingCandidate(
            centre, Rotation.from_rotvec([0.0, s * 0.01, 0.0]).as_matrix() @ axis, covariance
        )
        for s in (-1.0, 1.0)
    )
    after = innovation(
        state, RingMeasurement(0.0, "ring", pair, world.ring_of_target), QUIET
    ).updated
    assert np.allclose(after.rotation, state.rotation, atol=1e-4)
    alone = innovation(
        state, RingMeasurement(0.0, "ring", pair[:1], world.ring_of_target), QUIET
    ).updated
    assert np.trace(after.covariance[:3, :3]) > np.trace(alone.covariance[:3, :3])


def test_an_axis_of_either_sign_is_the_same_ring(world):
    state = begin(world.pose(0.0), QUIET)
    ring = world.ring(0.0)
    one = ring.candidates[0]
    root = world.rng.standard_normal((6, 6))
    mixed = 0.1 * one.covariance + 1e-6 * root @ root.T  # with covariance of centre and axis
    flipped = mixed.copy()
    flipped[:3, 3:] *= -1.0
    flipped[3:, :3] *= -1.0
    plus = replace(ring, candidates=(RingCandidate(one.centre_m, one.axis, mixed),))
    minus = replace(ring, candidates=(RingCandidate(one.centre_m, -one.axis, flipped),))
    a, b = (innovation(state, m, QUIET).updated for m in (plus, minus))
    assert np.allclose(a.rotation, b.rotation, atol=1e-12)
    assert np.allclose(a.covariance, b.covariance, atol=1e-15)


def test_a_sensor_mounted_elsewhere_says_the_same(world):
    sensor_from_camera = Pose(
        Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([0.4, -0.1, 0.2])
    )
    camera_from_sensor = sensor_from_camera.inverse()
    state = begin(world.pose(0.0), QUIET)
    turn = np.kron(np.eye(2), sensor_from_camera.rotation)
    pose = world.pose(0.0)
    elsewhere = PoseMeasurement(
        0.0, "camera", sensor_from_camera @ pose.pose, turn @ pose.covariance @ turn.T
    )
    ring = world.ring(0.0)
    seen = RingMeasurement(
        0.0,
        "ring",
        tuple(
            RingCandidate(
                sensor_from_camera.apply(c.centre_m),
                sensor_from_camera.rotation @ c.axis,
                turn @ c.covariance @ turn.T,
            )
            for c in ring.candidates
        ),
        world.ring_of_target,
    )
    beam = RangeMeasurement(0.0, "laser", 29.0, 0.02, (world.plane,))
    direct = replace(
        beam, origin_m=camera_from_sensor.translation_m,
        direction=camera_from_sensor.rotation @ np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    for here, there in ((pose, elsewhere), (ring, seen), (direct, beam)):
        a = innovation(state, here, QUIET)
        b = innovation(state, there.in_camera(sensor_from_camera), QUIET)
        assert np.allclose(a.updated.rotation, b.updated.rotation, atol=1e-12)
        assert np.allclose(a.updated.covariance, b.updated.covariance, atol=1e-12)


def test_what_is_far_off_is_rejected_with_its_distance(world):
    state = begin(world.pose(0.0), QUIET)
    lie = world.pose(0.0, offset=np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    found = update(state, lie, QUIET)
    assert isinstance(found, Rejected)
    assert found.nis > 100.0
    assert "σ away" in found.reason
    assert isinstance(update(state, world.pose(0.0), QUIET), FilterState)


def test_a_beam_along_the_surface_or_a_ring_behind_the_camera_cannot_be_compared(world):
    state = begin(world.pose(0.0), QUIET)
    along = replace(world.range(0.0), direction=np.array([1.0, 0.0, -0.01]))
    assert isinstance(innovation(state, along, QUIET), Rejected)
    behind = replace(state, translation_m=np.array([0.0, 0.0, -5.0]))
    assert isinstance(innovation(behind, world.ring(0.0), QUIET), Rejected)


def test_a_spot_beyond_the_surface_says_nothing(world):
    state = begin(world.pose(0.0), QUIET)
    beam = world.range(0.0)
    spot = state.pose.inverse().apply(
        [0.0, 0.0, float(world.start.apply(world.ring_of_target.centre_m)[2])]
    )
    away_m = float(np.linalg.norm(spot - world.ring_of_target.centre_m))
    for inner_m, outer_m, says in ((0.0, 0.5, False), (0.0, 5.0, True), (3.0, 5.0, False)):
        assert inner_m <= away_m <= outer_m or not says
        surface = replace(world.plane, inner_m=inner_m, outer_m=outer_m)
        found = innovation(state, replace(beam, surfaces=(surface,)), QUIET)
        assert isinstance(found, Rejected) is not says
    # The next surface stands in.
    narrow = replace(world.plane, outer_m=0.1)
    other = replace(world.plane, relief_m=0.3)
    found = innovation(state, replace(beam, surfaces=(narrow, other)), QUIET)
    assert found.bias == pytest.approx(0.09)


def test_wrong_arguments_are_named(world):
    state = begin(world.pose(0.0), QUIET)
    with pytest.raises(ValueError, match="forward only"):
        predict(state, -1.0, QUIET)
    with pytest.raises(ValueError, match="predict the state"):
        innovation(state, world.pose(1.0), QUIET)
    with pytest.raises(ValueError, match="finite"):
        world.pose(float("nan"))
    with pytest.raises(ValueError, match="positive definite"):
        PoseMeasurement(0.0, "camera", world.start, -np.eye(6))
    with pytest.raises(ValueError, match="positive"):
        replace(world.range(0.0), sigma_m=0.0)
    with pytest.raises(ValueError, match="unit vector"):
        RingCandidate(np.ones(3), np.ones(3), np.eye(6))
