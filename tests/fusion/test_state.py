"""Prediction and correction: biases, consistency, the unknown ring."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import chdtri
from tests.fusion.scenes import MOVE, PLANE, QUIET, RING, SIGMA, START, TURN, World, still_at, taken

from rendezview.fusion import (
    FusionOptions,
    MotionOptions,
    PoseMeasurement,
    RingCandidate,
    RingMeasurement,
    SensorOptions,
    predict,
)
from rendezview.fusion.hypothesis import look
from rendezview.fusion.prediction import estimate_of
from rendezview.fusion.state import RING_GEOMETRY, begin
from rendezview.geometry.pose import Pose

BIASED = SensorOptions(bias_share=0.9, bias_s=1e9, bias_range=1e9)


def covariance_of(state):
    return estimate_of(state)[2]


def sigmas(state):
    return np.sqrt(np.diag(covariance_of(state))[:6])


@pytest.mark.parametrize("options", [QUIET, FusionOptions()])
def test_the_first_state_is_the_first_pose(world, options):
    one = world.pose(0.0)
    pose, rates, covariance = estimate_of(begin(one, options))
    assert pose.rotation == pytest.approx(one.pose.rotation, abs=1e-12)
    assert pose.translation_m == pytest.approx(one.pose.translation_m, abs=1e-12)
    assert rates == pytest.approx(np.zeros(6))
    # A micrometre is the floor of any claim.
    assert covariance[:6, :6] == pytest.approx(one.covariance, abs=2e-12)
    motion = options.motion
    first = [motion.first_rate**2] * 3 + [motion.first_velocity**2] * 3
    # The velocity of the target's origin in the camera has that of the camera's turn, too.
    assert np.diag(covariance)[6:] == pytest.approx(first, rel=1e-9)


@pytest.mark.parametrize("step_s", [0.1, 1.0, 10.0])
def test_rates_go_on(world, step_s):
    """The camera's axes stay, the target turns and passes by, both against inertial space."""
    rates = (START.rotation.T @ TURN, -START.rotation.T @ MOVE)
    one = PoseMeasurement(0.0, "camera", START, np.eye(6) * 1e-6)
    state = begin(one, QUIET, rates)
    pose, found, _ = estimate_of(predict(state, step_s, QUIET))
    turn = Rotation.from_rotvec(TURN * step_s).as_matrix()
    assert pose.rotation == pytest.approx(turn @ START.rotation, abs=1e-9)
    assert pose.translation_m == pytest.approx(START.translation_m + step_s * MOVE, abs=1e-9)
    assert found == pytest.approx(np.concatenate([TURN, MOVE]), abs=1e-9)


def test_a_long_prediction_is_that_of_short_ones(world):
    options = FusionOptions()
    state = begin(world.pose(0.0), options)._replace(confirmed=True)
    for _ in range(20):
        state, _ = taken(predict(state, 0.5, options), world.pose(state.time_s + 0.5), options)
    whole, short = predict(state, 9.0, options), state
    for _ in range(18):
        short = predict(short, 0.5, options)
    one, other = estimate_of(whole), estimate_of(short)
    # A lasting acceleration fades within the step: a small part of what is not known.
    off = np.abs(one[0].translation_m - other[0].translation_m)
    assert np.all(off < 0.05 * sigmas(short)[3:])
    ratio = np.diag(one[2]) / np.diag(other[2])
    assert np.all((ratio > 0.7) & (ratio < 1.4)), ratio


@pytest.mark.requirement("RV-FUSE-3")
def test_normalised_errors_are_those_of_their_degrees_of_freedom(make_world):
    values = []
    motion = replace(QUIET.motion, first_rate=0.003, first_velocity=0.3)
    options = replace(QUIET, motion=motion)
    for seed in range(60):
        world = make_world(seed)
        turn, move = world.rng.normal(0.0, 0.003, 3), world.rng.normal(0.0, 0.3, 3)

        def truth(time_s, turn=turn, move=move):
            extra = Rotation.from_rotvec(turn * time_s).as_matrix()
            return Pose(extra @ START.rotation, START.translation_m + move * time_s)

        world.truth = truth
        state = begin(world.pose(0.0), options)
        for k in range(1, 8):
            state = predict(state, 1.0, options)
            for measurement in world.kinds(float(k)):
                state, verdict = taken(state, measurement, options)
                assert verdict.accepted
        pose, _, covariance = estimate_of(state)
        off = world.error(pose, truth(7.0))
        values.append(off @ np.linalg.solve(covariance[:6, :6], off))
    total = sum(values)
    assert chdtri(360, 0.999) < total < chdtri(360, 0.001)


def test_a_bias_is_not_averaged_away(world):
    bias = replace(QUIET, pose=BIASED)
    frozen, wide = world.pose(0.0), []
    for options in (bias, QUIET):
        state = begin(frozen, options)
        for _ in range(60):
            state = predict(state, 0.01, options)
            white = {"camera": 1.0 - np.full(6, options.pose.bias_share)}  # it stays as told
            state, _ = taken(state._replace(white=white), still_at(state, frozen), options)
        wide.append(sigmas(state))
    assert np.all(wide[0] > 0.9 * np.sqrt(0.9) * SIGMA)
    assert np.all(wide[1] < 0.5 * SIGMA)


@pytest.mark.parametrize("finer", [1.0, 10.0])
def test_a_sensor_that_is_finer_at_once_has_a_new_bias(finer, make_world):
    """It sees other parts now. Two sensors of one share of bias, of which one knows the place."""
    options = replace(QUIET, pose=BIASED)
    world = make_world(3)
    state = begin(world.pose(0.0, sensor="stereo"), options)
    off = 2.0 * SIGMA
    for _ in range(5):
        state, _ = taken(state, world.pose(0.0, off), options)
    slot = state.slots["camera"]
    before = state.weights @ state.deviations[:, slot.start : slot.start + 6]
    fine = world.pose(0.0, sigma=SIGMA / finer)
    found = look(state, fine, options)
    after = found.state.weights @ found.state.deviations[:, slot.start : slot.start + 6]
    assert np.abs(before).max() > 0.5
    assert after == pytest.approx(before / finer)


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_the_white_share_of_a_sensor_is_learnt(share):
    """Errors of which a known share lasts for the whole run."""
    found = []
    for seed in range(4):
        world, options = World(50 + seed, lambda time_s: START), QUIET
        options = replace(options, pose=SensorOptions(bias_share=0.5, bias_s=30.0, bias_range=1e9))
        state, lasting = None, world.rng.standard_normal(6)
        keep = math.exp(-0.5 / 30.0)
        for k in range(300):
            lasting = keep * lasting + math.sqrt(1.0 - keep**2) * world.rng.standard_normal(6)
            off = SIGMA * math.sqrt(1.0 - share) * lasting
            one = world.pose(0.5 * k, off, sigma=SIGMA * math.sqrt(share))
            one = replace(one, covariance=np.diag(SIGMA**2))
            if state is None:
                state = begin(one, options)
                continue
            state, _ = taken(predict(state, 0.5, options), one, options)
        found.append(state.white["camera"])
    assert np.mean(found) == pytest.approx(share, abs=0.2)


def test_two_sensors_with_biases_share_the_weight(world):
    options = FusionOptions(pose=SensorOptions(bias_share=0.9))
    state = begin(world.pose(0.0), options)
    one = sigmas(state)
    both, _ = taken(state, world.pose(0.0, sensor="stereo"), options)
    assert sigmas(both) == pytest.approx(one / np.sqrt(2.0), rel=3e-3)


def test_an_unknown_radius_and_depth_of_the_ring_are_found(make_world):
    world = make_world(5)
    options = replace(QUIET, ring_radius_sigma=0.1, ring_depth_sigma_m=0.5)
    told = replace(RING, centre_m=RING.centre_m - 0.25 * RING.axis)  # it is 0.25 m further
    state = begin(world.pose(0.0), options)
    for _ in range(1, 200):
        state = predict(state, 0.5, options)
        ring = world.ring(state.time_s, 0.003, 1e-3)
        one = ring.candidates[0]
        # True radius: 4 % more.
        small = RingCandidate(one.centre_m / 1.04, one.axis, one.covariance)
        seen = RingMeasurement(state.time_s, "ring", (small,), told)
        for measurement in (world.pose(state.time_s), seen):
            state, _ = taken(state, measurement, options)
    slot = state.slots[RING_GEOMETRY]
    entries = np.array([slot.start, slot.start + 1])
    scale = np.array([0.1, 0.5])
    sigma = scale * np.sqrt(np.diag(state.covariances[0])[entries])
    found = scale * np.array([state.mean(int(entry)) for entry in entries])
    assert found[0] == pytest.approx(0.04, abs=4.0 * sigma[0])
    assert found[1] == pytest.approx(0.25, abs=4.0 * sigma[1])
    assert sigma[0] < 0.004
    assert sigma[1] < 0.05


def test_of_two_circles_the_one_that_is_expected_counts(world):
    state = begin(world.pose(0.0), QUIET)
    true = world.ring(0.0)
    good = true.candidates[0]
    tilted = Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix() @ good.axis
    wrong = RingCandidate(good.centre_m, tilted, good.covariance)
    alone, lone = taken(state, true, QUIET)
    for candidates in ((good, wrong), (wrong, good)):
        both, verdict = taken(state, replace(true, candidates=candidates), QUIET)
        assert verdict.nis == pytest.approx(lone.nis, rel=1e-6)
        assert both.rotation == pytest.approx(alone.rotation, abs=1e-9)


def test_a_wrong_edge_counts_for_its_bearing_only(world):
    options = replace(QUIET, ring_other_edge=0.1)
    state = begin(world.pose(0.0), options)
    true = world.ring(0.0)
    one = true.candidates[0]
    inner = replace(one, centre_m=1.07 * one.centre_m)  # 7 % smaller, taken for the ring
    after, verdict = taken(state, replace(true, candidates=(inner,)), options)
    assert verdict.accepted
    assert "another edge" in verdict.reason
    assert verdict.nis < 10.0
    before_m, after_m = (estimate_of(s)[0].translation_m[2] for s in (state, after))
    assert abs(after_m - before_m) < 0.01
    assert taken(state, true, options)[1].reason is None
    beside = replace(one, centre_m=one.centre_m + np.array([3.0, 0.0, 0.0]))
    assert not taken(state, replace(true, candidates=(beside,)), options)[1].accepted


def test_what_is_far_off_is_rejected_with_its_distance(world):
    state = begin(world.pose(0.0), QUIET)
    lie = world.pose(0.0, offset=np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    after, verdict = taken(state, lie, QUIET)
    assert not verdict.accepted
    assert verdict.nis > 100.0
    assert "σ away" in verdict.reason
    assert np.array_equal(after.covariances, state.covariances)
    assert taken(state, world.pose(0.0), QUIET)[1].accepted


def test_a_range_that_cannot_be_compared_changes_nothing(world):
    state = begin(world.pose(0.0), QUIET)
    along = replace(world.range(0.0), direction=np.array([1.0, 0.0, -0.01]))
    after, verdict = taken(state, along, QUIET)
    assert not verdict.accepted
    assert verdict.nis is None
    assert "grazes" in verdict.reason
    assert np.array_equal(after.covariances, state.covariances)


def test_a_range_narrows_the_place_along_its_beam(world):
    state = begin(world.pose(0.0), QUIET)
    after, verdict = taken(state, replace(world.range(0.0, 1e-3), surfaces=(PLANE,)), QUIET)
    assert verdict.accepted
    before, now = sigmas(state), sigmas(after)
    assert now[5] < 0.5 * before[5]
    assert now[:5] == pytest.approx(before[:5], rel=0.2)


def test_a_state_without_a_confirmation_does_not_swing_beyond_its_linearisation(world):
    """A fast start, bridged for long: the rates' σ is bounded while nothing has told them."""
    options = FusionOptions(motion=MotionOptions(first_rate=0.5, first_velocity=10.0))
    state = begin(world.pose(0.0), options)
    covariance = covariance_of(predict(state, 8.0, options))
    assert np.sqrt(np.diag(covariance)[:3].max()) < 1.0
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_wrong_arguments_are_named(world):
    state = begin(world.pose(0.0), QUIET)
    for step_s in (-1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="forward only"):
            predict(state, step_s, QUIET)
    assert predict(state, 0.0, QUIET) is state
    with pytest.raises(ValueError, match="finite"):
        world.pose(float("nan"))
    with pytest.raises(ValueError, match="positive definite"):
        PoseMeasurement(0.0, "camera", START, -np.eye(6))
    with pytest.raises(ValueError, match="positive"):
        replace(world.range(0.0), sigma_m=0.0)
    with pytest.raises(ValueError, match="unit vector"):
        RingCandidate(np.ones(3), np.ones(3), np.eye(6))
