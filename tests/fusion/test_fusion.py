"""The filter as a whole: late measurements, trust, start, outage, new start, options."""

import threading

import numpy as np
import pytest
from tests.fusion.scenes import MOVE, SIGMA, START, drift

from rendezview.fusion import Fusion, PoseMeasurement
from rendezview.geometry.pose import Pose
from rendezview.sensors.observation import Status

AWAY = np.array([0.1, 0.0, 0.0, 0.4, -0.3, 0.5])


def series_of(world, count):
    """Three sensors, a tenth of a second apart, every half second."""
    return [
        make(0.5 * k + late)
        for k in range(count)
        for late, make in ((0.0, world.pose), (0.1, world.ring), (0.2, world.range))
    ]


def same(one, other, time_s):
    a, b = one.state_at(time_s), other.state_at(time_s)
    assert a.pose.rotation.tobytes() == b.pose.rotation.tobytes()
    assert a.pose.translation_m.tobytes() == b.pose.translation_m.tobytes()
    assert a.covariance.tobytes() == b.covariance.tobytes()
    for name, trust in one.trusts.items():
        beside = other.trusts[name]
        assert (trust.accepted, trust.received) == (beside.accepted, beside.received)


@pytest.mark.requirement("RV-FUSE-1")
def test_late_measurements_give_what_they_give_in_order(world):
    series = series_of(world, 40)
    ordered, shuffled = Fusion(), Fusion()
    for measurement in series:
        ordered.add(measurement)
    first, rest = series[:3], series[3:]
    for measurement in first:
        shuffled.add(measurement)
    # Each within 3 s of its place.
    order = np.argsort([m.time_s + world.rng.uniform(0.0, 3.0) for m in rest], kind="stable")
    assert np.any(np.diff(order) < 0)
    for k in order:
        assert shuffled.add(rest[k]).accepted
    same(ordered, shuffled, 20.0)


@pytest.mark.requirement("RV-FUSE-1")
def test_a_late_measurement_before_a_rejection_gives_what_it_gives_in_order(make_world):
    world = make_world(4)
    series = series_of(world, 60)
    for k in range(90, 108, 3):
        series[k] = world.pose(series[k].time_s, AWAY)
    ordered, late = Fusion(), Fusion()
    for measurement in series:
        ordered.add(measurement)
    held = series[85:95]  # they arrive after the next twenty
    for measurement in [*series[:85], *series[95:115], *held, *series[115:]]:
        late.add(measurement)
    assert ordered.trusts["camera"].accepted < ordered.trusts["camera"].received
    same(ordered, late, 30.0)


def test_a_pose_before_the_first_one_becomes_the_first(world):
    series = [world.pose(0.5 * k) for k in range(6)]
    ordered, late = Fusion(), Fusion()
    for measurement in series:
        ordered.add(measurement)
    for measurement in [series[2], series[0], series[1], *series[:2:-1]]:
        late.add(measurement)
    same(ordered, late, 3.0)
    assert late.starts == 1


def test_what_is_too_late_is_rejected_and_changes_nothing(world):
    fusion = Fusion()
    world.run(fusion, 0, 30)
    before = fusion.state_at(30.0)
    verdict = fusion.add(world.pose(5.0))
    assert not verdict.accepted
    assert "no longer remembered" in verdict.reason
    assert np.array_equal(before.covariance, fusion.state_at(30.0).covariance)
    with pytest.raises(ValueError, match="before the earliest remembered time"):
        fusion.state_at(3.0)


def test_rates_are_found(world):
    fusion = Fusion()
    world.run(fusion, 0, 60)
    estimate = fusion.state_at(60.0)
    assert estimate.status is Status.TRACKING
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.abs(estimate.rates[3:] - MOVE) == pytest.approx(np.zeros(3), abs=0.01)
    assert np.all(sigma[9:] < 0.01)


def test_rates_are_given_once_the_state_is_confirmed(world):
    fusion = Fusion()
    for k in range(fusion.options.start_with):
        fusion.add(world.pose(0.5 * k))
        estimate = fusion.state_at(0.5 * k)
        starting = k + 1 < fusion.options.start_with
        assert estimate.status is (Status.STARTING if starting else Status.TRACKING)
        assert (estimate.rates is None) is starting
        assert estimate.pose is not None


def test_nothing_but_ranges_starts_nothing(world):
    fusion = Fusion()
    assert fusion.state_at(0.0).status is Status.WAITING
    verdict = fusion.add(world.range(0.0))
    assert not verdict.accepted
    assert fusion.state_at(1.0).pose is None
    fusion.add(world.ring(0.5))
    assert fusion.state_at(1.0).status is Status.WAITING
    fusion.add(world.pose(1.0))
    assert fusion.state_at(1.0).status is Status.STARTING


def test_a_doubled_reading_is_no_second_one(world):
    """A reading sent twice makes the state hardly surer: bias and jitter are common to both."""
    once, twice = Fusion(), Fusion()
    for k in range(40):
        for measurement in (world.pose(0.5 * k), world.ring(0.5 * k)):
            once.add(measurement)
            twice.add(measurement)
            assert twice.add(measurement).accepted
    assert twice.starts == 1
    one, two = (np.sqrt(np.diag(f.state_at(19.5).covariance)[:6]) for f in (once, twice))
    assert np.all(two > 0.6 * one)
    assert world.squared(twice, 19.5) < 30.0


@pytest.mark.parametrize("claim", [1e-3, 1e-6])
def test_a_sensor_that_claims_too_much_gives_no_level_that_is_not_a_number(claim, make_world):
    for seed in range(4):
        world, fusion = make_world(seed), Fusion()
        for k in range(24):
            sharp = SIGMA * (claim if k % 3 == 1 else 1.0)
            fusion.add(world.pose(0.5 * k, sigma=sharp))
            fusion.add(world.pose(0.5 * k, sensor="stereo", sigma=sharp if k % 2 else SIGMA))
            estimate = fusion.state_at(0.5 * k)
            assert np.all(np.diag(estimate.covariance) > 0.0)
            assert np.all(estimate.protection.axes > 0.0)
            assert estimate.protection.position_m > 0.0


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_first_pose_is_left_at_once(seed, make_world):
    world = make_world(seed)
    fusion = Fusion()
    fusion.add(world.pose(0.0, 10.0 * AWAY))
    for k in range(1, 6):
        fusion.add(world.pose(0.5 * k))
    assert fusion.state_at(2.5).status is Status.TRACKING
    assert fusion.starts == 2
    assert world.squared(fusion, 2.5) < 30.0


def test_two_sensors_that_disagree_from_the_start_do_not_keep_it_starting(world):
    fusion = Fusion()
    for k in range(10):
        fusion.add(world.pose(0.5 * k, AWAY))
        fusion.add(world.pose(0.5 * k, sensor="stereo"))
    # Which of the two is right nobody can know: one is followed, the other named, with an alarm.
    estimate = fusion.state_at(4.5)
    assert estimate.status is Status.TRACKING
    assert sum(trust.locked for trust in fusion.trusts.values()) == 1
    assert estimate.protection.alarm
    for k in range(10, 24):  # a third one tells
        fusion.add(world.pose(0.5 * k, AWAY))
        fusion.add(world.pose(0.5 * k, sensor="stereo"))
        fusion.add(world.ring(0.5 * k))
    assert fusion.trusts["camera"].locked
    assert not fusion.trusts["stereo"].locked
    assert not fusion.trusts["ring"].locked
    assert world.squared(fusion, 11.5) < 30.0


def test_a_first_pose_of_a_sensor_that_then_is_silent_is_left_for_another(world):
    fusion = Fusion()
    fusion.add(world.pose(0.0, 10.0 * AWAY))
    for k in range(1, 16):
        fusion.add(world.pose(0.5 * k, sensor="stereo"))
    assert fusion.state_at(7.5).status is Status.TRACKING
    assert world.squared(fusion, 7.5) < 30.0


@pytest.mark.requirement("RV-FUSE-2")
@pytest.mark.parametrize(
    "sensors", [("camera", "laser"), ("camera", "ring"), ("camera", "ring", "laser")]
)
def test_a_sensor_that_lies_is_locked_out_and_let_in_when_it_agrees(sensors, make_world):
    world = make_world(7)
    fusion = Fusion()
    world.run(fusion, 0, 20, sensors=sensors)
    lied = world.run(fusion, 20, 35, sensors=sensors, offset=AWAY)["camera"]
    assert not any(verdict.accepted for verdict in lied)
    assert fusion.trusts["camera"].locked
    assert fusion.trusts["camera"].lockouts == 1
    assert fusion.state_at(35.0).protection.alarm
    assert world.squared(fusion, 35.0) < 30.0
    honest = world.run(fusion, 35, 45, sensors=sensors)["camera"]
    assert all(verdict.accepted for verdict in honest[2:])
    assert not fusion.trusts["camera"].locked
    assert not fusion.state_at(45.0).protection.alarm
    assert world.squared(fusion, 45.0) < 30.0
    assert fusion.starts == 1


def test_the_only_sensor_that_lies_for_a_while_is_not_believed(make_world):
    world = make_world(8)
    fusion = Fusion()
    lie = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    world.run(fusion, 0, 30, sensors=("camera",))
    lied = world.run(fusion, 30, 40, sensors=("camera",), offset=lie)["camera"]
    assert not any(verdict.accepted for verdict in lied)
    estimate = fusion.state_at(40.0)
    assert estimate.status is Status.COASTING
    assert "camera" in estimate.reason
    assert world.squared(fusion, 40.0) < 30.0
    honest = world.run(fusion, 40, 45, sensors=("camera",))["camera"]
    assert honest[-1].accepted
    assert fusion.starts == 1
    assert world.squared(fusion, 45.0) < 30.0


def test_a_dead_sensor_is_bridged_and_then_the_state_is_lost_and_restarted(world):
    fusion = Fusion()
    world.run(fusion, 0, 30)
    estimate = fusion.state_at(36.0)
    assert estimate.status is Status.COASTING
    assert "nothing believed for 6.5 s" in estimate.reason
    assert world.squared(fusion, 36.0) < 30.0
    late = fusion.state_at(4000.0)
    assert late.status is Status.LOST
    assert late.pose is None
    assert late.reason is not None
    # A jump while nobody looked: restarted from the first pose.
    steady = START.perturbed(np.array([0.5, 0.0, 0.0, 3.0, 0.0, 0.0]))
    world.truth = lambda t: steady
    verdict = fusion.add(world.pose(4000.0))
    assert verdict.began
    assert verdict.accepted
    assert fusion.starts == 2
    for k in range(1, 5):
        assert fusion.add(world.pose(4000.0 + 0.5 * k)).accepted
    assert fusion.state_at(4002.0).status is Status.TRACKING
    assert fusion.state_at(4002.0).note is not None
    assert world.squared(fusion, 4002.0) < 30.0


def test_a_sensor_that_returns_after_a_gap_is_believed(world):
    fusion = Fusion()
    world.run(fusion, 0, 30, sensors=("camera",))
    for k in range(100, 110):
        assert fusion.add(world.pose(0.5 * k)).accepted
    assert fusion.starts == 1
    assert world.squared(fusion, 54.5) < 30.0


def test_two_sensors_that_agree_overrule_a_state_that_is_wrong(world):
    fusion = Fusion()
    sensors = ("camera", "ring")
    world.run(fusion, 0, 20, sensors=sensors)
    # A sudden manoeuvre, beyond every assumption: both sensors see it.
    leap = np.array([0.0, 0.0, 0.05, 1.0, -1.0, 2.0])
    world.truth = lambda t: drift(t).perturbed(leap)
    world.run(fusion, 20, 24, sensors=sensors)
    assert world.squared(fusion, 23.5) < 30.0
    assert not any(trust.locked for trust in fusion.trusts.values())
    assert fusion.state_at(23.5).status in (Status.TRACKING, Status.STARTING)


def test_a_clock_that_is_late_is_noticed(make_world):
    world = make_world(9)
    fusion = Fusion()
    world.run(fusion, 0, 30)
    for k in range(60, 120):
        fusion.add(world.pose(0.5 * k))
        fusion.add(world.ring(0.5 * k))
        stale = world.range(0.5 * k - 2.0)  # 0.4 m behind the truth
        fusion.add(type(stale)(0.5 * k, "laser", stale.range_m, stale.sigma_m, stale.surfaces))
    assert fusion.trusts["laser"].locked
    assert world.squared(fusion, 59.5) < 30.0


def test_threads_that_add_and_ask_get_what_one_thread_gets(make_world):
    world = make_world(11)
    series = [make(0.1 * k) for k in range(60) for make in (world.pose, world.ring, world.range)]
    alone, shared = Fusion(), Fusion()
    for measurement in series:
        alone.add(measurement)
    # One thread adds in order, others ask at the same time.
    done = threading.Event()

    def ask() -> None:
        while not done.is_set():
            shared.state_at(100.0)

    askers = [threading.Thread(target=ask) for _ in range(2)]
    for thread in askers:
        thread.start()
    for measurement in series:
        shared.add(measurement)
    done.set()
    for thread in askers:
        thread.join()
    same(alone, shared, 6.0)
    # Several threads add: none is lost. The first pose is there before the others.
    many = Fusion()
    many.add(series[0])
    adders = [
        threading.Thread(target=lambda k=k: [many.add(m) for m in series[1 + k :: 3]])
        for k in range(3)
    ]
    for thread in adders:
        thread.start()
    for thread in adders:
        thread.join()
    assert sum(trust.received for trust in many.trusts.values()) == len(series)


def test_nothing_to_take_changes_nothing(world):
    fusion = Fusion()
    assert fusion.add(None) is None
    assert fusion.trusts == {}
    assert fusion.time_s is None


def test_a_filter_goes_on_from_the_last_estimate_of_another():
    """Its rates carry it on: without them the place were known to metres after a few seconds."""
    first, second = Fusion(), Fusion()
    moving = np.array([0.0, 0.0, -0.1])
    for k in range(12):
        place = np.array([0.1, 0.2, 20.0]) + k * moving
        first.add(PoseMeasurement(float(k), "camera", Pose(np.eye(3), place), 1e-4 * np.eye(6)))
    last = first.state_at(11.0)
    second.resume(last)
    ahead = second.state_at(15.0)
    assert ahead.status == Status.TRACKING
    assert ahead.pose.translation_m == pytest.approx(place + 4.0 * moving, abs=0.05)
    kept, known = second.state_at(11.0).covariance, last.covariance
    assert np.diag(kept)[:6] == pytest.approx(np.diag(known)[:6])
    for rows in (slice(6, 9), slice(9, 12)):
        assert np.trace(kept[rows, rows]) == pytest.approx(4.0 * np.trace(known[rows, rows]), 0.05)
    assert not second.add(PoseMeasurement(10.0, "camera", last.pose, 1e-4 * np.eye(6))).accepted
    with pytest.raises(ValueError, match="has begun"):
        second.resume(last)
    with pytest.raises(ValueError, match="without a pose"):
        Fusion().resume(Fusion().state_at(0.0))
