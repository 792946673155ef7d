"""Motion, jitter, faults: what the filter follows, and what it does not believe."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.fusion.scenes import SIGMA, START, TURN, World, along_axis, course, drift, with_jitter

from rendezview.fusion import Fusion
from rendezview.geometry.pose import Pose
from rendezview.sensors.observation import Status

DEGREE = math.radians(1.0)
AWAY = np.array([0.1, 0.0, 0.0, 0.4, -0.3, 0.5])


def readings(world, count, *makes, step_s=0.5):
    """Every sensor's measurement at each time."""
    return (make(step_s * k) for k in range(count) for make in makes)


def braking(slowing_m_s2, from_s=20.0):
    """From 40 m at 0.5 m/s, and slower from a time on, down to 0.05 m/s."""

    def range_m(time_s):
        after_s = max(time_s - from_s, 0.0)
        braked_s = min(after_s, 0.45 / slowing_m_s2)
        way_m = 0.5 * min(time_s, from_s) + 0.5 * braked_s - 0.5 * slowing_m_s2 * braked_s**2
        return 40.0 - way_m - 0.05 * (after_s - braked_s)

    return along_axis(range_m)


def thrust(step_m_s, at_s=30.0):
    def path(time_s):
        still = drift(time_s)
        return Pose(still.rotation, still.translation_m + step_m_s * max(time_s - at_s, 0.0))

    return path


@pytest.mark.parametrize("hertz", [0.15, 0.5, 1.0, 3.0])
def test_pointing_jitter_does_not_restart_it_and_the_pose_is_no_worse_than_the_sensors(hertz):
    for seed in range(2):
        world = World(seed, with_jitter(drift, 0.3 * DEGREE, hertz, seed))
        run = course(world, readings(world, 120, world.pose))
        assert run.fusion.starts == 1
        assert run.fusion.trusts["camera"].accepted >= 117
        assert run.fusion.trusts["camera"].lockouts == 0
        assert run.place_ratio() < 0.8
        assert run.attitude_ratio() < 0.8
        assert 2.0 < run.squared[10:].mean() < 9.0


def test_jitter_is_learnt_and_is_not_found_where_there_is_none():
    found = []
    for sigma_rad in (0.0, 0.3 * DEGREE):
        world = World(1, with_jitter(drift, sigma_rad, 1.0, 1))
        # Sharper than the jitter, as a recognizer close by.
        sharp = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.05])
        run = course(world, (world.pose(0.5 * k, sigma=sharp) for k in range(100)))
        rates = run.fusion.state_at(49.5).covariance
        found.append((run.fusion, rates))
    (still, sure), (swinging, unsure) = found
    assert still.starts == swinging.starts == 1
    quiet, loud = (f.state_at(50.5).covariance[:3, :3].trace() for f in (still, swinging))
    assert loud > 4.0 * quiet  # a second ahead, the attitude swings
    # The target's rate does not take the camera's jitter for its own.
    assert unsure[6:9, 6:9].trace() < 100.0 * sure[6:9, 6:9].trace()
    assert np.linalg.norm(swinging.state_at(49.5).rates[:3] - TURN) < 5e-3


@pytest.mark.parametrize("slowing_m_s2", [2e-3, 5e-3, 1e-2, 2e-2])
def test_a_braking_chaser_is_followed(slowing_m_s2):
    for seed in range(2):
        world = World(seed, braking(slowing_m_s2))
        run = course(world, readings(world, 160, world.pose))
        assert run.fusion.starts == 1
        assert run.fusion.trusts["camera"].accepted == 160
        assert run.place_ratio() < 0.9
        assert 1.5 < run.squared[10:].mean() < 8.0
        while_braking = np.linalg.norm(run.fused[40:60, 3:], axis=1)
        assert np.all(while_braking < 0.25)


@pytest.mark.parametrize("step_m_s", [0.1, 0.2, 0.3, 0.5])
@pytest.mark.parametrize("ranger", [False, True])
def test_a_step_of_thrust_is_a_manoeuvre_and_no_restart(step_m_s, ranger):
    for seed in range(3):
        world = World(seed, thrust(step_m_s * np.array([0.8, -0.5, 0.3])))
        makes = (world.pose, world.range) if ranger else (world.pose,)
        run = course(world, readings(world, 80, *makes))
        assert run.fusion.starts == 1
        # The first reading after the step may be turned away, for the next one tells.
        assert run.fusion.trusts["camera"].received - run.fusion.trusts["camera"].accepted <= 1
        assert run.place_ratio() < 1.0
        # A step that is taken for the camera's swing is seen by the second reading after it.
        over = np.linalg.norm(run.fused[:, 3:], axis=1) / run.levels[:, 1]
        assert np.sum(over > 1.0) <= 2
        assert over.max() < 1.5
        assert run.squared[64:].max() < 30.0


def test_a_manoeuvre_leaves_the_state_tracking_and_its_rates_known():
    """A chaser that steers by the rates has them during its own manoeuvre."""
    for seed in range(4):
        world = World(seed, thrust(np.array([0.24, -0.15, 0.09])))
        fusion = Fusion()
        for k in range(80):
            fusion.add(world.pose(0.5 * k))
            if k >= 10:
                estimate = fusion.state_at(0.5 * k)
                assert estimate.status is Status.TRACKING, (seed, 0.5 * k)
                assert estimate.rates is not None


@pytest.mark.parametrize("seed", range(4))
def test_a_fast_tumbling_target_is_followed_from_the_start(seed):
    axis = np.random.default_rng(seed).standard_normal(3)
    turn = 10.0 * DEGREE * axis / np.linalg.norm(axis)
    world = World(seed, along_axis(lambda t: 30.0 - 0.1 * t, turn))
    run = course(world, readings(world, 40, world.pose))
    assert run.fusion.starts == 1
    assert run.fusion.trusts["camera"].accepted == 40
    assert run.squared.max() < 30.0
    assert run.place_ratio(3) < 1.1
    assert run.attitude_ratio(3) < 1.0
    rates = run.fusion.state_at(19.5).rates
    assert rates[:3] == pytest.approx(turn, abs=5e-3)


@pytest.mark.parametrize("seed", range(3))
def test_one_reading_in_twenty_may_be_an_outlier(seed):
    world = World(seed)
    fusion, honest_lost, lies, outside = Fusion(), {"camera": 0, "laser": 0}, 0, 0
    for k in range(200):
        time_s = 0.5 * k
        wrong = world.rng.random(2) < 0.05
        if k < 5:  # not the first few: which of two poses is wrong, nobody can know
            wrong[:] = False
        lie = np.array([0.3, 0.3, 0.3, 1.0, 1.0, 2.0]) * world.rng.standard_normal(6)
        told = fusion.add(world.pose(time_s, lie if wrong[0] else None))
        assert not (told.accepted and wrong[0])
        honest_lost["camera"] += not wrong[0] and not told.accepted
        fusion.add(world.ring(time_s))
        beam = world.range(time_s)
        if wrong[1]:
            far_m = beam.range_m + world.rng.choice([-1.0, 1.0]) * world.rng.uniform(0.5, 2.0)
            beam = replace(beam, range_m=far_m)
        told = fusion.add(beam)
        assert not (told.accepted and wrong[1])
        honest_lost["laser"] += not wrong[1] and not told.accepted
        lies += wrong.sum()
        outside += world.squared(fusion, time_s) > 22.5
    assert lies > 8
    assert fusion.starts == 1
    assert outside <= 1
    assert fusion.state_at(99.5).status is Status.TRACKING
    # An outlier is one reading: the next one is believed.
    assert honest_lost["camera"] <= 2
    assert honest_lost["laser"] <= 2
    assert fusion.trusts["camera"].lockouts == fusion.trusts["laser"].lockouts == 0


def to_contact(world, fusion, until_m, scale=None, aside_m=0.0, camera=True):
    """From 4 m inwards; below 1.25 m the ring is another edge, or something beside it."""
    sharp = np.array([2e-3, 2e-3, 2e-3, 2e-3, 2e-3, 4e-3])
    told = []
    for k in range(150):
        time_s, away_m = 0.5 * k, 4.0 - 0.02 * k
        if camera or away_m > 1.6:
            fusion.add(world.pose(time_s, sigma=sharp))
        ring = world.ring(time_s, 2e-3, scale=scale or 1.0 if away_m < 1.25 else 1.0)
        if away_m < 1.25 and aside_m:
            one = ring.candidates[0]
            moved = replace(one, centre_m=one.centre_m + np.array([aside_m, 0.0, 0.0]))
            ring = replace(ring, candidates=(moved,))
        verdict = fusion.add(ring)
        if away_m < 1.25:
            told.append(verdict)
        fusion.add(world.range(time_s, 0.01))
        if away_m < until_m:
            return time_s, told
    raise AssertionError("the way ends before")


@pytest.mark.parametrize("camera", [True, False])
def test_a_ring_770_mm_off_at_1_2_m_moves_nothing(camera):
    """A smaller edge taken for the ring seems 1.64 times as far: only its bearing counts."""
    world = World(1, along_axis(lambda t: 4.0 - 0.04 * t, 0.1 * TURN))
    fusion = Fusion()
    time_s, told = to_contact(world, fusion, 1.1, scale=1.64, camera=camera)
    assert len(told) > 5
    assert all("another edge" in verdict.reason for verdict in told)
    off = world.error(fusion.state_at(time_s).pose, world.truth(time_s))
    assert np.linalg.norm(off[3:]) < 0.03
    assert world.squared(fusion, time_s) < 30.0
    assert fusion.starts == 1


@pytest.mark.parametrize("camera", [True, False])
def test_a_ring_770_mm_beside_its_place_is_turned_away(camera):
    world = World(1, along_axis(lambda t: 4.0 - 0.04 * t, 0.1 * TURN))
    fusion = Fusion()
    time_s, told = to_contact(world, fusion, 1.1, aside_m=0.77, camera=camera)
    assert len(told) > 5
    assert not any(verdict.accepted for verdict in told)
    off = world.error(fusion.state_at(time_s).pose, world.truth(time_s))
    assert np.linalg.norm(off[3:]) < 0.03
    assert world.squared(fusion, time_s) < 30.0
    assert fusion.starts == 1
    assert fusion.state_at(time_s).protection.alarm


SCENES = {
    "steady": drift,
    "jitter": with_jitter(drift, 0.3 * DEGREE, 1.0, 5),
    "braking": braking(1e-2),
    "thrust": thrust(np.array([0.16, -0.1, 0.06])),
}


def test_the_protection_level_contains_the_error():
    outside = total = 0
    for scene, path in SCENES.items():
        for seed in range(2):
            world = World(20 + seed, path)
            run = course(world, readings(world, 150, world.pose, world.ring))
            place = np.linalg.norm(run.fused[:, 3:], axis=1) > run.levels[:, 1]
            turned = np.linalg.norm(run.fused[:, :3], axis=1) > run.levels[:, 0]
            outside += np.sum(place | turned)
            total += len(place)
            # A level that is wide without a reason protects nobody.
            assert np.median(run.levels[20:, 1]) < 8.0 * np.sqrt((SIGMA[3:] ** 2).sum()), scene
    assert total == 1200
    assert outside <= 5  # its risk is one in a thousand


def test_an_alarm_is_raised_while_two_sensors_contradict_and_the_level_contains_both():
    for seed in range(3):
        world = World(seed)
        fusion = Fusion()
        alarms = []
        for k in range(120):
            time_s, lies = 0.5 * k, 40 <= k < 80
            fusion.add(world.pose(time_s, AWAY if lies else None))
            fusion.add(world.pose(time_s, sensor="stereo"))
            estimate = fusion.state_at(time_s)
            alarms.append(estimate.protection.alarm)
            off = world.error(estimate.pose, world.truth(time_s))
            assert np.linalg.norm(off[3:]) < estimate.protection.position_m, (seed, time_s)
        assert all(alarms[41:80])
        assert not any(alarms[5:40])
        assert not any(alarms[90:])
        assert fusion.starts == 1
        assert world.squared(fusion, 59.5) < 30.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("liar_first", [True, False])
def test_of_two_that_contradict_from_the_start_a_third_one_tells(seed, liar_first):
    world, fusion = World(30 + seed), Fusion()
    for k in range(60):
        time_s = 0.5 * k
        pair = [world.pose(time_s, AWAY), world.pose(time_s, sensor="stereo")]
        for one in pair if liar_first else reversed(pair):
            fusion.add(one)
        if k >= 20:
            fusion.add(world.ring(time_s))
        elif k > 2:
            assert fusion.state_at(time_s).protection.alarm
    assert fusion.trusts["camera"].locked
    assert not fusion.trusts["stereo"].locked
    assert not fusion.trusts["ring"].locked
    assert fusion.state_at(29.5).status is Status.TRACKING
    assert world.squared(fusion, 29.5) < 30.0


def test_a_wrong_start_is_left_though_the_first_sensor_goes_on_with_the_truth():
    """Any size of a first error, from a few σ to half a turn."""
    for seed, size in enumerate((0.5, 1.0, 3.0, 10.0, 30.0)):
        world, fusion = World(seed), Fusion()
        fusion.add(world.pose(0.0, size * AWAY))
        for k in range(1, 12):
            fusion.add(world.pose(0.5 * k))
        assert fusion.state_at(5.5).status is Status.TRACKING, size
        assert world.squared(fusion, 5.5) < 30.0, size


@pytest.mark.parametrize("size", [1.0, 10.0])
@pytest.mark.parametrize("degrees_s", [3.0, 10.0])
def test_a_wrong_start_before_a_tumbling_target_is_left(degrees_s, size):
    for seed in range(2):
        axis = np.random.default_rng(seed).standard_normal(3)
        turn = degrees_s * DEGREE * axis / np.linalg.norm(axis)
        world, fusion = World(seed, along_axis(lambda t: 30.0 - 0.1 * t, turn)), Fusion()
        fusion.add(world.pose(0.0, size * AWAY))
        for k in range(1, 16):
            fusion.add(world.pose(0.5 * k))
        assert fusion.state_at(7.5).status is Status.TRACKING
        assert world.squared(fusion, 7.5) < 30.0


@pytest.mark.parametrize("speed_m_s", [1.0, 5.0])
def test_a_target_that_is_passed_fast_is_followed_from_the_start(speed_m_s):
    move = speed_m_s * np.array([1.0, 0.0, -0.3])
    world = World(1, lambda t: Pose(START.rotation, START.translation_m + move * t))
    run = course(world, readings(world, 16, world.pose))
    assert run.fusion.starts == 1
    assert run.fusion.trusts["camera"].accepted == 16
    assert run.squared[2:].max() < 30.0  # of two poses either may be wrong: it is starting
    assert run.fusion.state_at(7.5).rates[3:] == pytest.approx(move, abs=0.05)


@pytest.mark.parametrize("liar", [0, 1, 2])
def test_of_three_sensors_the_one_that_lies_from_the_start_is_found(liar):
    world, fusion, names = World(5 + liar), Fusion(), ("camera", "stereo", "reflectors")
    for k in range(20):
        for place, name in enumerate(names):
            fusion.add(world.pose(0.5 * k, AWAY if place == liar else None, sensor=name))
    for place, name in enumerate(names):
        assert fusion.trusts[name].locked is (place == liar)
    assert world.squared(fusion, 9.5) < 30.0


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_a_sensor_that_lies_for_long_beside_another_moves_nothing(size):
    """Eighty seconds: longer than any patience."""
    world, fusion = World(2), Fusion()
    for k in range(200):
        time_s, lies = 0.5 * k, 20 <= k < 180
        told = fusion.add(world.pose(time_s, size * AWAY if lies else None))
        assert not (lies and told.accepted)
        assert fusion.add(world.pose(time_s, sensor="stereo")).accepted
        if k % 10 == 0:
            assert world.squared(fusion, time_s) < 30.0
    assert told.accepted
    assert fusion.starts == 1


def test_readings_with_common_errors_are_not_averaged_to_certainty():
    """Errors that last: the normalised error stays near its degrees of freedom."""
    levels = []
    for seed in range(6):
        world = World(40 + seed)
        lasting, squared = world.rng.standard_normal(6), []
        fusion = Fusion()
        for k in range(160):
            keep = math.exp(-0.5 / 30.0)
            lasting = keep * lasting + math.sqrt(1.0 - keep**2) * world.rng.standard_normal(6)
            one = world.pose(
                0.5 * k, SIGMA * math.sqrt(0.8) * lasting, sigma=SIGMA * math.sqrt(0.2)
            )
            fusion.add(replace(one, covariance=np.diag(SIGMA**2)))
            if k >= 40:
                squared.append(world.squared(fusion, 0.5 * k))
        levels.append(np.mean(squared))
    assert 3.0 < np.mean(levels) < 9.0
