"""The tracker: following, losing, finding again, false lights, filter."""

from __future__ import annotations

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.plain_laboratory import rotation_of

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import MotionOptions, Spots, StereoTracker, TrackerOptions
from rendezview.sensors.beacons.match.agreement import LightsFit, distance
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.led_laboratory import Laboratory

POSE = Pose(rotation_of(0.7, 0.2, -0.1), [0.05, -0.08, 0.3])


@pytest.fixture
def tracker(laboratory: Laboratory, scole) -> StereoTracker:
    return StereoTracker.of_target(laboratory.rig, scole)


def away(pose: Pose, observation) -> float:
    """Squared distance from the truth in standard deviations."""
    fit = observation.fit
    return distance(
        fit, LightsFit(pose.rotation, pose.translation_m, fit.information, 0, 0, 0, None)
    )


def test_without_noise_the_pose_is_exact_in_the_first_cameras_frame(tracker, laboratory, read):
    spots = read(laboratory.rig, laboratory.currents([POSE], None)[0])
    observation = tracker.update(0.0, spots)
    truth = laboratory.rig.cameras[0].camera_from_rig @ POSE
    assert observation.status is Status.OK
    assert observation.restarted
    assert observation.pose.angle_to(truth) < 1e-6
    assert observation.pose.translation_m == pytest.approx(truth.translation_m, abs=1e-6)
    assert observation.yaw_pitch_roll == pytest.approx((0.7, 0.2, -0.1), abs=1e-6)


@pytest.mark.requirement("RV-STEREO-1")
def test_errors_are_those_of_the_covariance_and_of_the_bound(tracker, laboratory, read):
    rng = np.random.default_rng(1)
    currents = laboratory.currents([POSE] * 600, rng)
    errors, told = [], []
    truth = laboratory.rig.cameras[0].camera_from_rig @ POSE
    for k, reading in enumerate(currents):
        observation = tracker.update(float(k), read(laboratory.rig, reading))
        turned = Rotation.from_matrix(observation.pose.rotation @ truth.rotation.T).as_rotvec()
        errors.append([*turned, *(observation.pose.translation_m - truth.translation_m)])
        told.append(np.diag(observation.covariance))
    scatter = np.std(errors, axis=0)
    assert scatter == pytest.approx(np.sqrt(np.mean(told, axis=0)), rel=0.12)
    both = np.kron(np.eye(2), laboratory.rig.rotations[0])
    bound = np.sqrt(np.diag(both @ laboratory.bound(POSE) @ both.T))
    assert scatter == pytest.approx(bound, rel=0.12)


@pytest.mark.requirement("RV-STEREO-1")
@pytest.mark.parametrize("pitch_deg", [0.0, 89.0, 90.0])
def test_no_attitude_is_singular(laboratory, pitch_deg: float):
    # The lights turned so that the cameras still see them while eq. 3 passes its pole
    pole = rotation_of(0.3, np.deg2rad(pitch_deg), 0.2)
    leds = laboratory.leds @ pole  # p_target = poleᵀ p
    tracker = StereoTracker(laboratory.rig, leds)
    currents = laboratory.currents([Pose.identity()], np.random.default_rng(2))[0]
    spots = [c.photodiode.read(x) for c, x in zip(laboratory.rig.cameras, currents, strict=True)]
    observation = tracker.update(0.0, spots)
    assert away(Pose(pole, np.zeros(3)), observation) < 30.0


def test_from_nothing_the_pose_is_found_at_any_yaw(tracker, laboratory, read):
    rng = np.random.default_rng(3)
    for yaw in rng.uniform(-np.pi, np.pi, 60):
        tilt = rng.uniform(-0.6, 0.6, 2)
        pose = Pose(rotation_of(yaw, *tilt), rng.uniform(-0.1, 0.1, 3))
        sights = laboratory.rig.sights(read(laboratory.rig, laboratory.currents([pose], rng)[0]), 6)
        found = tracker.locate(sights)
        assert isinstance(found, LightsFit), found
        truth = LightsFit(pose.rotation, pose.translation_m, found.information, 0, 0, 0, sights)
        assert distance(found, truth) < 50.0


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("fault", ["swapped", "swapped once", "reflected", "two missing"])
def test_false_and_missing_lights_do_not_spoil_the_pose(
    tracker, laboratory, read, fault: str, known: bool
):
    rng = np.random.default_rng(4)
    light = laboratory.currents([POSE, POSE], rng)
    bad = light[1]
    if fault == "swapped":
        bad[:, [1, 4]] = bad[:, [4, 1]]
    elif fault == "swapped once":
        bad[0, [0, 3]] = bad[0, [3, 0]]
    elif fault == "reflected":
        bad[1, 2] = laboratory.light(1, np.array([0.003, -0.002]))
    else:
        bad[:, [0, 5]] = np.nan
    if known:
        tracker.update(0.0, read(laboratory.rig, light[0]))
    observation = tracker.update(1.0, read(laboratory.rig, bad))
    assert observation.status is Status.OK, observation.reason
    assert observation.restarted != known
    assert away(POSE, observation) < 40.0
    assert observation.exchanged == {"swapped": ((1, 4),), "swapped once": ((0, 3),)}.get(fault, ())
    assert observation.left_out == (((1, 2),) if fault == "reflected" else ())


def test_spots_that_are_not_the_target_are_refused(tracker, laboratory, read):
    rng = np.random.default_rng(5)
    wrong = np.stack([laboratory.light(k, rng.uniform(-0.004, 0.004, (6, 2))) for k in range(2)])
    observation = tracker.update(0.0, read(laboratory.rig, wrong))
    assert observation.pose is None
    assert observation.covariance is None
    assert observation.status is Status.DISAGREE
    assert "do not fit the target" in observation.reason


def test_too_few_lights_are_no_pose_and_the_next_reading_finds_it_again(tracker, laboratory, read):
    rng = np.random.default_rng(6)
    turned = Pose(rotation_of(-2.0, 0.1, 0.1), [0.0, 0.1, 0.0])
    light = laboratory.currents([POSE, POSE, turned], rng)
    light[1, :, 2:] = np.nan
    assert tracker.update(0.0, read(laboratory.rig, light[0])).pose is not None
    lost = tracker.update(1.0, read(laboratory.rig, light[1]))
    assert (lost.status, lost.pose) == (Status.FEW_LIGHTS, None)
    nothing = tracker.update(2.0, [Spots.none(), Spots.none()])
    assert nothing.status is Status.FEW_LIGHTS
    again = tracker.update(3.0, read(laboratory.rig, light[2]))
    assert away(turned, again) < 40.0


def test_three_lights_in_one_camera_are_ambiguous_until_a_forecast_chooses(laboratory, read):
    rng = np.random.default_rng(7)
    tracker = StereoTracker(laboratory.rig, laboratory.leds)  # beams unknown
    light = laboratory.currents([POSE, POSE, POSE], rng)
    light[[0, 2], 1] = np.nan
    light[0, 0, 3:] = np.nan
    observation = tracker.update(0.0, read(laboratory.rig, light[0]))
    assert (observation.status, observation.pose) == (Status.AMBIGUOUS, None)
    assert "poses fit" in observation.reason
    assert tracker.update(1.0, read(laboratory.rig, light[1])).status is Status.OK
    alone = tracker.update(2.0, read(laboratory.rig, light[2]))  # six lights, one camera
    assert away(POSE, alone) < 40.0


def test_the_filter_scatters_less_and_gives_every_reading(laboratory, scole, read):
    rng = np.random.default_rng(8)
    angles = np.deg2rad(np.arange(80) * 0.5)
    poses = laboratory.stage(angles)
    currents = laboratory.currents(poses, rng)
    scatter = {}
    for name, motion in (("alone", None), ("filter", MotionOptions())):
        tracker = StereoTracker.of_target(laboratory.rig, scole, TrackerOptions(motion=motion))
        errors, told = [], []
        for k, (pose, reading) in enumerate(zip(poses, currents, strict=True)):
            observation = tracker.update(0.1 * k, read(laboratory.rig, reading))
            assert observation.status is Status.OK
            turned = observation.rig_from_target.rotation @ pose.rotation.T
            errors.append(Rotation.from_matrix(turned).as_rotvec())
            told.append(np.trace(observation.covariance[:3, :3]))
        scatter[name] = np.sqrt(np.mean(np.square(errors[20:])) * 3)
        assert scatter[name] == pytest.approx(np.sqrt(np.mean(told[20:])), rel=0.4)
    assert scatter["filter"] < 0.6 * scatter["alone"]


def test_the_filter_lives_through_two_lights_and_believes_a_jump(laboratory, scole, read):
    rng = np.random.default_rng(9)
    jumped = Pose(rotation_of(2.5, 0.0, 0.1), [0.0, 0.0, 0.0])
    light = laboratory.currents([POSE] * 12 + [jumped], rng)
    light[10, :, 2:] = np.nan
    options = TrackerOptions(motion=MotionOptions())
    tracker = StereoTracker.of_target(laboratory.rig, scole, options)
    observations = [
        tracker.update(0.1 * k, read(laboratory.rig, reading)) for k, reading in enumerate(light)
    ]
    partial = observations[10]
    assert partial.status is Status.PARTIAL
    assert "2 lights" in partial.reason
    assert partial.rig_from_target.angle_to(POSE) < np.deg2rad(3.0)
    assert partial.fit is None
    last = observations[12].rig_from_target
    assert last.angle_to(jumped) < np.deg2rad(8.0)
    assert last.angle_to(POSE) > 1.0


def test_wrong_use_is_refused(laboratory, tracker, read):
    spots = read(laboratory.rig, laboratory.currents([POSE], None)[0])
    tracker.update(1.0, spots)
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(1.0, spots)
    with pytest.raises(ValueError, match="cameras"):
        tracker.update(2.0, spots[:1])
    assert tracker.update(2.0, spots).pose is not None  # what was refused has taken no time
    with pytest.raises(RendezviewError, match="at least 3"):
        StereoTracker(laboratory.rig, np.zeros((2, 3)))
    with pytest.raises(RendezviewError, match="one line"):
        StereoTracker(laboratory.rig, np.outer(np.arange(4.0), [1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match="beyond"):
        tracker.update(3.0, [Spots([[0.0, 0.0]], [[1e-5, 1e-5]], [9]), Spots.none()])
    with pytest.raises(ValueError, match="finite"):
        Spots([[np.nan, 0.0]], [[1.0, 1.0]], [0])


def test_threads_get_what_one_thread_gets(laboratory, scole, read):
    rng = np.random.default_rng(12)
    currents = laboratory.currents([POSE] * 40, rng)
    spots = [read(laboratory.rig, reading) for reading in currents]
    options = TrackerOptions(motion=MotionOptions())

    def run() -> list[bytes]:
        tracker = StereoTracker.of_target(laboratory.rig, scole, options)
        found = [tracker.update(0.1 * k, one) for k, one in enumerate(spots)]
        return [one.pose.translation_m.tobytes() + one.covariance.tobytes() for one in found]

    alone = run()
    with ThreadPoolExecutor(4) as pool:
        assert all(future.result() == alone for future in [pool.submit(run) for _ in range(4)])


def test_one_tracker_in_two_threads_answers_one_call_after_the_other(laboratory, scole, read):
    rng = np.random.default_rng(13)
    spots = [read(laboratory.rig, one) for one in laboratory.currents([POSE] * 60, rng)]
    tracker, clock = StereoTracker.of_target(laboratory.rig, scole), itertools.count()
    order = threading.Lock()

    def work(part: list) -> int:
        done = 0
        for one in part:
            with order:  # times must rise
                done += tracker.update(float(next(clock)), one).status is Status.OK
        return done

    with ThreadPoolExecutor(2) as pool:
        assert sum(pool.map(work, (spots[::2], spots[1::2]))) == len(spots)


def test_an_observation_is_a_measurement_and_a_line_of_the_log(tracker, laboratory, read):
    observation = tracker.update(2.5, read(laboratory.rig, laboratory.currents([POSE], None)[0]))
    taken = observation.measurement("stereo")
    assert (taken.time_s, taken.sensor, taken.pose) == (2.5, "stereo", observation.pose)
    assert taken.covariance == pytest.approx(observation.covariance, rel=1e-12)
    line = observation.record()
    assert list(line) == [
        "time_s", "status", "reason", "pose", "covariance", "rig_from_target",
        "yaw_pitch_roll_rad", "common_covariance", "budget", "rates", "sum_of_squares",
        "degrees_of_freedom", "left_out", "exchanged", "leds", "found_anew", "stage_ms",
    ]  # fmt: skip
    assert line["leds"][0] == list(tracker.names.leds)
    assert list(line["stage_ms"]) == ["track"]
    nothing = tracker.update(3.0, [Spots.none(), Spots.none()])
    assert nothing.measurement("stereo") is None


def test_pose_and_covariance_in_the_first_camera_are_those_of_dense_matrices(
    tracker, laboratory, read
):
    reading = laboratory.currents([POSE], np.random.default_rng(14))[0]
    observation = tracker.update(0.0, read(laboratory.rig, reading))
    first = laboratory.rig.cameras[0].camera_from_rig
    expected = first @ observation.rig_from_target
    assert observation.pose.rotation == pytest.approx(expected.rotation, abs=1e-14)
    assert observation.pose.translation_m == pytest.approx(expected.translation_m, abs=1e-13)
    both = np.kron(np.eye(2), first.rotation)
    spread = both @ np.linalg.inv(observation.fit.information) @ both.T
    assert observation.covariance == pytest.approx(spread, rel=1e-9, abs=1e-16)
