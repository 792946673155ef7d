"""The filter as a whole: late measurements, trust, start, outage, new start."""

import threading

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.fusion import (
    Fusion,
    FusionOptions,
    MotionOptions,
    PoseMeasurement,
    SensorOptions,
)
from rendezview.fusion.logs import read_options
from rendezview.geometry.pose import Pose
from rendezview.sensors.observation import Status

WHITE = SensorOptions(bias_share=0.0)
OPTIONS = FusionOptions(
    motion=MotionOptions(angular=1e-5, linear=1e-4, pointing=1e-5),
    pose=WHITE,
    ring=WHITE,
    range=WHITE,
)
AWAY = np.array([0.1, 0.0, 0.0, 0.4, -0.3, 0.5])


def run(fusion, world, start_s, end_s, *, sensors=("camera", "ring", "laser"), offset=None):
    """Half a second between measurements; verdicts by sensor."""
    told = {"camera": [], "ring": [], "laser": []}
    for k in range(round(2 * start_s), round(2 * end_s)):
        for measurement in (
            world.pose(0.5 * k, offset),
            world.ring(0.5 * k),
            world.range(0.5 * k),
        ):
            if measurement.sensor in sensors:
                told[measurement.sensor].append(fusion.add(measurement))
    return told


def away(fusion, world, time_s):
    estimate = fusion.state_at(time_s)
    off = world.error(estimate.pose, world.truth(time_s))
    return off @ np.linalg.solve(estimate.covariance[:6, :6], off)


@pytest.mark.requirement("RV-FUSE-1")
def test_late_measurements_give_what_they_give_in_order(world):
    series = [
        make(0.5 * k + late)
        for k in range(40)
        for late, make in ((0.0, world.pose), (0.1, world.ring), (0.2, world.range))
    ]
    ordered, shuffled = Fusion(OPTIONS), Fusion(OPTIONS)
    for measurement in series:
        ordered.add(measurement)
    first, rest = series[:3], series[3:]
    for measurement in first:
        shuffled.add(measurement)
    # Each within 3 s of its place.
    order = np.argsort([m.time_s + world.rng.uniform(0.0, 3.0) for m in rest], kind="stable")
    for k in order:
        assert shuffled.add(rest[k]).accepted
    a, b = ordered.state_at(20.0), shuffled.state_at(20.0)
    assert np.allclose(a.pose.translation_m, b.pose.translation_m, atol=1e-9)
    assert np.allclose(a.covariance, b.covariance, atol=1e-12)
    assert {n: t.accepted for n, t in ordered.trusts.items()} == {
        n: t.accepted for n, t in shuffled.trusts.items()
    }


def test_what_is_too_late_is_rejected_and_changes_nothing(world):
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 30)
    before = fusion.state_at(30.0)
    verdict = fusion.add(world.pose(5.0))
    assert not verdict.accepted
    assert "no longer remembered" in verdict.reason
    assert np.array_equal(before.covariance, fusion.state_at(30.0).covariance)
    with pytest.raises(ValueError, match="before the earliest remembered time"):
        fusion.state_at(3.0)


def test_rates_are_found(world):
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 60)
    estimate = fusion.state_at(60.0)
    assert estimate.status is Status.TRACKING
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.abs(estimate.rates[3:] - world.move) == pytest.approx(np.zeros(3), abs=0.01)
    assert np.all(sigma[9:] < 0.01)


def test_nothing_but_ranges_starts_nothing(world):
    fusion = Fusion(OPTIONS)
    assert fusion.state_at(0.0).status is Status.WAITING
    verdict = fusion.add(world.range(0.0))
    assert not verdict.accepted
    assert fusion.state_at(1.0).pose is None
    fusion.add(world.pose(1.0))
    assert fusion.state_at(1.0).status is Status.STARTING


def test_a_wrong_first_pose_is_left_at_once(world):
    fusion = Fusion(OPTIONS)
    fusion.add(world.pose(0.0, 10.0 * AWAY))
    for k in range(1, 5):
        fusion.add(world.pose(0.5 * k))
    assert fusion.state_at(2.0).status is Status.TRACKING
    assert fusion.starts == 2
    assert away(fusion, world, 2.0) < 30.0


def test_two_sensors_that_disagree_from_the_start_do_not_keep_it_starting(world):
    fusion = Fusion(OPTIONS)
    for k in range(10):
        fusion.add(world.pose(0.5 * k, AWAY))
        fusion.add(world.pose(0.5 * k, sensor="stereo"))
    # Which of the two is right nobody can know: the first is followed, and the other named.
    assert fusion.state_at(4.5).status is Status.TRACKING
    assert fusion.starts == 1
    assert fusion.trusts["stereo"].locked
    for k in range(10, 20):  # a third one tells
        fusion.add(world.pose(0.5 * k, AWAY))
        fusion.add(world.pose(0.5 * k, sensor="stereo"))
        fusion.add(world.ring(0.5 * k))
    assert fusion.starts == 2
    assert fusion.trusts["camera"].locked
    assert away(fusion, world, 9.5) < 30.0


def test_a_first_pose_of_a_sensor_that_then_is_silent_is_left_for_another(world):
    fusion = Fusion(OPTIONS)
    fusion.add(world.pose(0.0, 10.0 * AWAY))
    for k in range(1, 8):
        fusion.add(world.pose(0.5 * k, sensor="stereo"))
    assert fusion.state_at(3.5).status is Status.TRACKING
    assert away(fusion, world, 3.5) < 30.0


@pytest.mark.requirement("RV-FUSE-2")
@pytest.mark.parametrize(
    "sensors", [("camera", "laser"), ("camera", "ring"), ("camera", "ring", "laser")]
)
def test_a_sensor_that_lies_is_locked_out_and_let_in_when_it_agrees(sensors, make_world):
    world = make_world(7)
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 20, sensors=sensors)
    lied = run(fusion, world, 20, 50, sensors=sensors, offset=AWAY)["camera"]
    assert not any(verdict.accepted for verdict in lied)
    assert fusion.trusts["camera"].locked
    assert fusion.state_at(50.0).status is Status.TRACKING
    assert away(fusion, world, 50.0) < 30.0
    honest = run(fusion, world, 50, 60, sensors=sensors)["camera"]
    assert honest[-1].accepted
    assert not fusion.trusts["camera"].locked
    assert away(fusion, world, 60.0) < 30.0
    assert fusion.starts == 1


def test_the_only_sensor_that_lies_is_not_believed_when_the_forecast_has_grown_wide(make_world):
    world = make_world(8)
    loose = FusionOptions(
        motion=MotionOptions(angular=2e-4, linear=2e-3, pointing=1e-5),
        pose=WHITE,
        lost_range_fraction=0.2,
    )
    fusion = Fusion(loose)
    lie = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    run(fusion, world, 0, 20, sensors=("camera",))
    lied = run(fusion, world, 20, 60, sensors=("camera",), offset=lie)["camera"]
    assert not any(verdict.accepted for verdict in lied)
    # Wide enough by now: the lie alone would pass.
    sigma_m = np.sqrt(fusion.state_at(60.0).covariance[3, 3])
    assert sigma_m > 0.15
    assert fusion.state_at(60.0).status is Status.COASTING
    honest = run(fusion, world, 60, 65, sensors=("camera",))["camera"]
    assert honest[-1].accepted
    assert fusion.starts == 1
    assert away(fusion, world, 65.0) < 30.0


def test_a_dead_sensor_is_bridged_and_then_the_state_is_lost_and_restarted(world):
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 10)
    estimate = fusion.state_at(20.0)
    assert estimate.status is Status.COASTING
    assert away(fusion, world, 20.0) < 30.0
    late = fusion.state_at(4000.0)
    assert late.status is Status.LOST
    assert late.pose is None
    assert late.reason is not None
    # A jump while nobody looked: restarted from the first pose.
    world.start = world.start.perturbed(np.array([0.5, 0.0, 0.0, 3.0, 0.0, 0.0]))
    time_s = 4000.0
    steady = world.truth(0.0)
    world.truth = lambda t: steady
    verdict = fusion.add(world.pose(time_s))
    assert verdict.began
    assert verdict.accepted
    for k in range(1, 5):
        assert fusion.add(world.pose(time_s + 0.5 * k)).accepted
    assert fusion.state_at(time_s + 2.0).status is Status.TRACKING
    assert away(fusion, world, time_s + 2.0) < 30.0


def test_two_sensors_that_agree_overrule_a_state_that_is_wrong(world):
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 20, sensors=("camera", "ring"))
    # A sudden manoeuvre, beyond every assumption: both sensors see it.
    world.start = world.start.perturbed(np.array([0.0, 0.0, 0.05, 1.0, -1.0, 2.0]))
    run(fusion, world, 20, 24, sensors=("camera", "ring"))
    assert fusion.starts == 2
    assert away(fusion, world, 23.5) < 30.0
    assert not any(trust.locked for trust in fusion.trusts.values())


def test_a_clock_that_is_late_is_noticed(make_world):
    world = make_world(9)
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 30)
    for k in range(60, 120):
        fusion.add(world.pose(0.5 * k))
        fusion.add(world.ring(0.5 * k))
        stale = world.range(0.5 * k - 2.0)  # 0.4 m behind the truth
        fusion.add(type(stale)(0.5 * k, "laser", stale.range_m, stale.sigma_m, stale.surfaces))
    assert fusion.trusts["laser"].locked
    assert away(fusion, world, 60.0) < 30.0


def test_an_error_that_each_gate_passes_is_noticed_by_the_mean_of_nis(world):
    fusion = Fusion(OPTIONS)
    run(fusion, world, 0, 20, sensors=("camera", "ring"))
    noisy = SensorOptions(bias_share=0.0)
    assert noisy.nis_limit == 3.0
    for k in range(40, 160):
        fusion.add(world.pose(0.5 * k))
        # Three times the noise that it claims, cut where the gate would notice.
        draw = np.clip(3.0 * world.rng.standard_normal(), -3.5, 3.5)
        fusion.add(world.ring(0.5 * k))
        one = world.range(0.5 * k, 1e-9)
        fusion.add(type(one)(0.5 * k, "laser", one.range_m + 0.02 * draw, 0.02, one.surfaces))
    assert fusion.trusts["laser"].lockouts >= 1
    assert fusion.trusts["camera"].lockouts == 0


def test_threads_that_add_and_ask_get_what_one_thread_gets(make_world):
    world = make_world(11)
    series = [make(0.1 * k) for k in range(60) for make in (world.pose, world.ring, world.range)]
    alone, shared = Fusion(OPTIONS), Fusion(OPTIONS)
    for measurement in series:
        alone.add(measurement)
    # One thread adds in order, others ask at the same time.
    done = threading.Event()

    def ask() -> None:
        while not done.is_set():
            shared.state_at(100.0)

    askers = [threading.Thread(target=ask) for _ in range(3)]
    for thread in askers:
        thread.start()
    for measurement in series:
        shared.add(measurement)
    done.set()
    for thread in askers:
        thread.join()
    expected, found = alone.state_at(6.0), shared.state_at(6.0)
    assert found.covariance.tobytes() == expected.covariance.tobytes()
    assert found.pose.translation_m.tobytes() == expected.pose.translation_m.tobytes()
    # Several threads add: none is lost.
    many = Fusion(OPTIONS)
    adders = [
        threading.Thread(target=lambda k=k: [many.add(m) for m in series[k::3]]) for k in range(3)
    ]
    for thread in adders:
        thread.start()
    for thread in adders:
        thread.join()
    assert sum(trust.received for trust in many.trusts.values()) >= len(series) - 2


def test_nothing_to_take_changes_nothing(world):
    fusion = Fusion(OPTIONS)
    assert fusion.add(None) is None
    assert fusion.trusts == {}


def test_options_take_the_keys_of_files_and_the_names_of_fields(tmp_path):
    file = tmp_path / "options.json"
    file.write_text('{"pose": {"lasting": 0.5, "bias_s": 7.0}, "ring": {"lasting_range": 0.1}}')
    options = read_options(file)
    assert (options.pose.bias_share, options.pose.bias_s) == (0.5, 7.0)
    assert options.ring.bias_range == 0.1
    file.write_text('{"pose": {"share": 0.5}}')
    with pytest.raises(RendezviewError, match="share"):
        read_options(file)


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
    assert ahead.pose.translation_m == pytest.approx(place + 4.0 * moving, abs=0.02)
    kept, known = np.diag(second.state_at(11.0).covariance), np.diag(last.covariance)
    assert kept[:6] == pytest.approx(known[:6])
    assert kept[6:] == pytest.approx(4.0 * known[6:])
    assert not second.add(PoseMeasurement(10.0, "camera", last.pose, 1e-4 * np.eye(6))).accepted
    with pytest.raises(ValueError, match="has begun"):
        second.resume(last)
    with pytest.raises(ValueError, match="without a pose"):
        Fusion().resume(Fusion().state_at(0.0))
