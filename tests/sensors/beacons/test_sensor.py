"""Acquisition, tracking, hand-over, several cameras: the sensor on simulated pictures."""

import math

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.io.target import Reflector
from rendezview.sensors.beacons import (
    Acquirer,
    LitDark,
    ReflectorPattern,
    ReflectorSensor,
    SixNumbers,
    TrackingOptions,
    find_spots,
    patterns_of,
    pose_of,
    predict_spots,
)
from rendezview.sensors.beacons.cameras import RangedCamera, SwitchingSensor
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.beacons.match.triplets import PAPER_HOURGLASS, hourglass_of
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.background import Earth, earth_radiance
from rendezview_ground.simulate.reflector_frames import Clutter, foil

AHEAD = SixNumbers(3.0, 0.03, -0.02, 0.2, 0.15, -0.1)


def approach(t):
    """Six numbers at time t, s: slow enough for the windows."""
    return SixNumbers(
        4.0 - 0.1 * t, 0.03 * math.sin(t), 0.02 * math.cos(t), 0.2 + 0.02 * t, 0.15, -0.1
    )


def sunlit_earth(camera, rng, grey):
    """Background of both pictures: the Earth somewhere below."""
    down = rng.normal(size=3) * (1.0, 1.0, 0.3) + (0.0, 0.0, 0.8)
    sun = rng.normal(size=3)
    earth = Earth(seed=int(rng.integers(1 << 31)))
    radiance, _ = earth_radiance(
        camera, down / np.linalg.norm(down), sun / np.linalg.norm(sun), earth
    )
    return np.float32(grey) * radiance


def close(pose, truth, range_m):
    return (
        np.linalg.norm(pose.translation_m - truth.translation_m) < 0.003 * range_m
        and pose.angle_to(truth) < 0.01
    )


def test_the_hourglass_of_the_papers_target_is_the_papers(three):
    glass = hourglass_of(three, (0, 1, 2), math.radians(40.0), nearest_base=100.0)
    assert (glass.x0, glass.y0) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert glass.slope == pytest.approx(PAPER_HOURGLASS.slope, rel=0.03)
    assert glass.x_intercept == pytest.approx(PAPER_HOURGLASS.x_intercept, rel=0.08)
    assert glass.y_intercept == pytest.approx(PAPER_HOURGLASS.y_intercept, rel=0.15)


@pytest.mark.requirement("RV-REFL-2")
@pytest.mark.parametrize("range_m", [1.2, 3.0, 8.0])
@pytest.mark.parametrize(
    "angles", [(0.03, -0.02, 0.2, 0.15, -0.1), (0.0,) * 5], ids=["aside", "head on"]
)
def test_the_target_is_found_and_its_half_turn_told(picture, three, paper_camera, range_m, angles):
    rng = np.random.default_rng(0)
    six = SixNumbers(range_m, *angles)
    found = Acquirer(paper_camera, [three]).acquire(find_spots(picture(three, six, rng)))
    assert found.status is Status.OK
    assert found.roll_ambiguous
    assert close(found.refined.camera_from_target, pose_of(six, three), range_m)


def test_foil_and_earth_do_not_hide_the_target(picture, three, paper_camera):
    rng = np.random.default_rng(2)
    acquirer = Acquirer(paper_camera, [three])
    for _ in range(6):
        sheet = foil(paper_camera, rng, 20)
        places = predict_spots(paper_camera, three, pose_of(AHEAD, three))
        apart = np.linalg.norm(sheet.spots[:, None, :2] - places, axis=-1).min(axis=1)
        clutter = (
            Clutter(sheet.spots[apart > 40.0]),
            Clutter(background=sunlit_earth(paper_camera, rng, 120.0)),
        )
        found = acquirer.acquire(find_spots(picture(three, AHEAD, rng, clutter=clutter)))
        assert close(found.refined.camera_from_target, pose_of(AHEAD, three), 3.0)


@pytest.mark.parametrize("hidden", [(0,), (1,), (0, 2), (0, 1, 2)])
def test_with_a_reflector_hidden_there_is_no_pose(picture, three, paper_camera, hidden):
    frames = picture(three, AHEAD, np.random.default_rng(3), hidden=hidden)
    found = Acquirer(paper_camera, [three]).acquire(find_spots(frames))
    assert found.status is Status.NO_SPOTS
    assert "three are needed" in found.reason


@pytest.mark.requirement("RV-REFL-1")
@pytest.mark.parametrize("hidden", [(), (0,), (1,), (3,), (0, 4)])
def test_any_three_of_five_reflectors_do(picture, five, paper_camera, hidden):
    frames = picture(five, AHEAD, np.random.default_rng(4), hidden=hidden)
    prior = pose_of(AHEAD, five).perturbed([0.1, 0, 0, 0, 0, 0.1])
    found = Acquirer(paper_camera, [five]).acquire(find_spots(frames), prior)
    assert found.status is Status.OK, found.reason
    assert len(found.reflectors) == 5 - len(hidden)
    assert close(found.refined.camera_from_target, pose_of(AHEAD, five), 3.0)


def test_two_equal_targets_are_ambiguous_and_a_prior_range_chooses(picture, three, paper_camera):
    rng = np.random.default_rng(5)
    here = picture(three, SixNumbers(3.0, -0.15, 0.0, 0.0, 0.1, 0.1), rng)
    there = picture(three, SixNumbers(5.0, 0.2, 0.0, 0.0, 0.1, 0.1), rng)
    both = LitDark(np.maximum(here.lit, there.lit), here.dark)
    acquirer = Acquirer(paper_camera, [three])
    assert acquirer.acquire(find_spots(both)).status is Status.AMBIGUOUS
    prior = pose_of(SixNumbers(5.2, 0.1, 0.0, 0.0, 0.0, 0.0), three)
    found = acquirer.acquire(find_spots(both), prior)
    far = np.linalg.norm(found.refined.camera_from_target.translation_m)
    assert far == pytest.approx(5.0, rel=0.01)


def test_tracking_follows_and_its_rates_are_the_motions(picture, three, paper_camera):
    rng = np.random.default_rng(6)
    sensor = ReflectorSensor(paper_camera, [three])
    assert sensor.update(0.0, picture(three, approach(0.0), rng)).status is Status.UNCONFIRMED
    for k in range(1, 16):
        reading = sensor.update(0.1 * k, picture(three, approach(0.1 * k), rng))
        truth = pose_of(approach(0.1 * k), three)
        assert reading.status is Status.OK
        assert reading.tracked == (k > 1)
        assert close(reading.pose, truth, 4.0)
    assert reading.rates.six_per_s[0] == pytest.approx(-0.1, abs=0.01)
    assert reading.rates.six_per_s[3] == pytest.approx(0.02, abs=0.01)
    sigma = math.sqrt(reading.rates.covariance[5, 5])
    assert 1e-4 < sigma < 0.01


def test_lost_reflectors_are_named_waited_for_and_found_again(picture, three, paper_camera):
    rng = np.random.default_rng(7)
    sensor = ReflectorSensor(paper_camera, [three])
    hidden = {5: (0,), 6: (0,), 8: (0, 1), 11: (0, 1, 2), 12: (0, 1, 2)}
    seen = []
    for k in range(15):
        frames = picture(three, approach(0.1 * k), rng, hidden=hidden.get(k, ()))
        reading = sensor.update(0.1 * k, frames)
        seen.append(reading.status)
        assert (reading.pose is None) == (k == 0 or k in hidden)
        if k == 5:
            assert "not visible: left" in reading.reason
        if reading.pose is not None:
            assert close(reading.pose, pose_of(approach(0.1 * k), three), 4.0)
    assert seen[5:9] == [Status.PARTIAL, Status.PARTIAL, Status.OK, Status.PARTIAL]
    assert seen[11:] == [Status.LOST, Status.LOST, Status.OK, Status.OK]


def test_after_a_long_occlusion_the_whole_picture_is_searched_at_the_old_range(
    picture, three, paper_camera
):
    rng = np.random.default_rng(8)
    sensor = ReflectorSensor(paper_camera, [three])
    for k in range(25):
        frames = picture(three, approach(0.1 * k), rng, hidden=(0, 1, 2) if 3 <= k < 20 else ())
        reading = sensor.update(0.1 * k, frames)
        if k == 20:
            assert not reading.tracked
    assert reading.status is Status.OK
    assert reading.tracked
    assert reading.roll_ambiguous  # as before


def test_a_glint_that_crosses_a_reflector_moves_no_pose(picture, three, paper_camera):
    rng = np.random.default_rng(9)
    sensor = ReflectorSensor(paper_camera, [three])
    statuses = []
    for k in range(24):
        six = approach(0.1 * k)
        place = predict_spots(paper_camera, three, pose_of(six, three))[2]
        glint = np.array([[place[0] + 3.0 * (k - 12), place[1], 2.5, 1.5, 0.3, 300.0, 0, 0, 0]])
        clutter = (Clutter(glint),) if k > 2 else ()
        reading = sensor.update(0.1 * k, picture(three, six, rng, clutter=clutter))
        statuses.append(reading.status)
        if reading.pose is not None:
            truth = pose_of(six, three)
            off = np.linalg.norm(reading.pose.translation_m - truth.translation_m)
            assert off < 0.03 * six.range_m
    assert statuses[-1] is Status.OK
    assert statuses.count(Status.OK) > 12


def test_an_acceleration_moves_the_windows(picture, three, paper_camera):
    rng = np.random.default_rng(10)

    def run(push):
        sensor = ReflectorSensor(
            paper_camera, [three], tracking=TrackingOptions(window_px=3.0, window_sizes=2.0)
        )
        tracked = []
        for k in range(8):
            az = 0.5 * 0.06 * k * k * 0.25
            six = SixNumbers(6.0, az - 0.1, 0.0, 0.0, 0.1, 0.1)
            give = push if k > 1 else None
            tracked.append(sensor.update(0.5 * k, picture(three, six, rng), give).tracked)
        return tracked[2:]

    assert not all(run(None))
    assert all(run([0.0, 0.0, 0.0, 6.0 * 0.06, 0.0, 0.0]))


def test_a_camera_that_jerks_loses_no_reading(picture, three, paper_camera):
    rng, sensor = np.random.default_rng(15), ReflectorSensor(paper_camera, [three])
    for k in range(12):
        six = SixNumbers(7.0, *rng.normal(0.0, 0.02, 2), 0.1, 0.1, 0.1)
        reading = sensor.update(float(k), picture(three, six, rng))
        if k:
            assert reading.status is Status.OK, k
            assert reading.six.azimuth_rad == pytest.approx(six.azimuth_rad, abs=1e-3)


def test_far_hands_over_to_near_and_their_offset_tells_the_roll(client, picture, paper_camera):
    patterns = patterns_of(client)
    far, near = patterns
    assert (far.name, near.name) == ("far", "near")
    rng = np.random.default_rng(11)
    sensor = ReflectorSensor(paper_camera, patterns)
    everything = merged(patterns)
    groups = []
    for k in range(40):
        range_m = 9.0 * 0.95**k
        six = SixNumbers(range_m, 0.0, 0.0, 2.9, 0.05, 0.05)  # upside down
        reading = sensor.update(0.5 * k, picture(everything, pose_of(six, near), rng))
        if reading.pose is not None:
            assert close(reading.pose, pose_of(six, near), 6.0)
            assert not reading.roll_ambiguous
            groups.append(reading.group)
    assert groups[0] == "far"
    assert groups[-1] == "near"
    assert len(groups) > 36


def test_single_pictures_of_lights_do_too(picture, three, paper_camera):
    rng = np.random.default_rng(12)
    sensor = ReflectorSensor(paper_camera, [three])
    for k in range(4):
        frames = picture(three, approach(0.1 * k), rng, dark=False, black_level_grey=40.0)
        reading = sensor.update(0.1 * k, frames)
    assert reading.tracked
    assert close(reading.pose, pose_of(approach(0.3), three), 4.0)


def test_cameras_switch_over_with_range(picture, three, paper_camera):
    rng = np.random.default_rng(13)
    mounted = Pose(np.eye(3), np.array([0.05, 0.0, 0.0]))
    cameras = [
        RangedCamera("wide", ReflectorSensor(paper_camera, [three]), Pose.identity(), 0.0, 3.9),
        RangedCamera("long", ReflectorSensor(paper_camera, [three]), mounted, 3.7, 50.0),
    ]
    switching = SwitchingSensor(cameras)
    used = []
    for k in range(10):
        truth = pose_of(approach(0.5 * k), three)  # chaser_from_target
        camera = switching.active
        used.append(camera.name)
        _, found = switching.update(0.5 * k, picture(three, camera.camera_from_chaser @ truth, rng))
        if k > 0:
            assert close(found, truth, 4.0)
    assert used == ["long"] * 8 + ["wide"] * 2
    with pytest.raises(RendezviewError, match="no camera is in use"):
        SwitchingSensor([cameras[0], RangedCamera("x", cameras[1].sensor, mounted, 5.0, 9.0)])


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_picture_of_nothing_says_so(three, paper_camera, level):
    flat = np.full((384, 512), level, np.uint8)
    sensor = ReflectorSensor(paper_camera, [three])
    for k, frames in enumerate((LitDark(flat), LitDark(flat, flat))):
        reading = sensor.update(float(k), frames)
        assert reading.status is Status.NO_SPOTS
        assert reading.pose is None


def test_noise_alone_is_no_target(three, paper_camera):
    rng = np.random.default_rng(14)
    sensor = ReflectorSensor(paper_camera, [three])
    for k in range(4):
        lit, dark = rng.integers(0, 256, (2, 384, 512)).astype(np.uint8)
        assert sensor.update(float(k), LitDark(lit, dark)).pose is None


def test_wrong_pictures_and_times_are_refused(three, paper_camera):
    sensor = ReflectorSensor(paper_camera, [three])
    with pytest.raises(RendezviewError, match="640 × 480"):
        sensor.update(0.0, LitDark(np.zeros((480, 640), np.uint8)))
    blank = LitDark(np.zeros((384, 512), np.uint8))
    sensor.update(1.0, blank)
    with pytest.raises(ValueError, match="order of time"):
        sensor.update(1.0, blank)
    with pytest.raises(ValueError, match="acceleration"):
        sensor.update(2.0, blank, [np.nan] * 6)


def test_reflectors_that_give_no_pose_are_refused(client):
    def reflector(name, x, normal=(0.0, 0.0, 1.0)):
        return Reflector(name, "g", np.array([x, 0.0, 0.0]), np.array(normal), 0.02)

    with pytest.raises(RendezviewError, match="needs three"):
        ReflectorPattern.of("g", (reflector("a", 0.0), reflector("b", 1.0)))
    with pytest.raises(RendezviewError, match="triangle"):
        ReflectorPattern.of("g", tuple(reflector(n, x) for n, x in (("a", 0), ("b", 1), ("c", 2))))
    with pytest.raises(RendezviewError, match="no reflector group 'x'"):
        patterns_of(client, ("x",))


def test_pictures_that_cannot_be_written_to_are_followed(picture, three, paper_camera):
    """As a decoder or a memory map gives them."""
    rng, sensor = np.random.default_rng(8), ReflectorSensor(paper_camera, [three])
    for k in range(4):
        frames = picture(three, approach(0.1 * k), rng)
        lit, dark = (one.copy() for one in (frames.lit, frames.dark))
        lit.setflags(write=False)
        dark.setflags(write=False)
        reading = sensor.update(0.1 * k, LitDark(lit, dark))
    assert reading.tracked
    assert close(reading.pose, pose_of(approach(0.3), three), 4.0)
