"""Lights that shine one after the other: a turning target is read at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.plain_readings import squared_error

from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.sensors.beacons import StereoTracker
from rendezview.sensors.beacons.multiplex import MultiplexedTracker
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions

SLOT_S, READING_S = 1.0 / 60.0, 0.1
SETTLED = 10  # readings before the errors count


@dataclass(frozen=True)
class Errors:
    """Of the readings after the first second."""

    turn_deg: float  # median
    light_mm: float  # median of the farthest light
    nees: float  # mean; 6 is right
    poses: int  # of all readings, the first ones too


def errors(laboratory: Laboratory, rate_deg_s: float, corrected: bool, readings: int) -> Errors:
    """Errors of a stage that turns at one rate and swings by 0.1 m, ten readings a second."""
    rng = np.random.default_rng(3)

    def at(time_s: float) -> Pose:
        turn = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(rate_deg_s) * time_s]).as_matrix()
        return Pose(turn, np.array([0.1 * np.sin(0.5 * time_s), 0.0, 0.0]))

    plain = StereoTracker(laboratory.rig, laboratory.leds)
    offsets = SLOT_S * np.arange(len(laboratory.leds))
    tracker = MultiplexedTracker(plain, offsets) if corrected else plain
    first, known = laboratory.rig.cameras[0].camera_from_rig, 0
    turns, lights, squares = [], [], []
    for k in range(readings):
        time_s = READING_S * k
        currents = laboratory.scan(at, time_s + offsets, rng)
        cameras = zip(laboratory.rig.cameras, currents, strict=True)
        found = tracker.update(time_s, [camera.photodiode.read(seen) for camera, seen in cameras])
        if found.status is not Status.OK or found.pose is None:
            continue
        known += 1
        if k < SETTLED:
            continue
        truth = first @ at(time_s)
        apart = found.pose.apply(laboratory.leds) - truth.apply(laboratory.leds)
        turns.append(found.pose.angle_to(truth))
        lights.append(np.linalg.norm(apart, axis=1).max())
        squares.append(squared_error(found, truth))
    if not turns:
        return Errors(np.nan, np.nan, np.nan, known)
    turn_deg, light_mm = np.rad2deg(np.median(turns)), 1e3 * np.median(lights)
    return Errors(float(turn_deg), float(light_mm), float(np.mean(squares)), known)


@pytest.fixture(scope="module")
def laboratory() -> Laboratory:
    """SCOLE's six lights before two perfect photodiodes."""
    leds = np.array([led.position_m for led in find_target("scole").leds])
    options = LaboratoryOptions(signal_to_noise=4000.0, distorted=False)
    return Laboratory(leds, options, 5)


def test_a_scan_of_a_turning_target_is_read_at_its_beginning(laboratory):
    still = errors(laboratory, 0.0, True, 40)
    bent = errors(laboratory, 20.0, False, 40)
    timed = errors(laboratory, 20.0, True, 40)
    assert still.poses == timed.poses == 40
    assert timed.turn_deg < 0.1
    assert timed.light_mm < 2.0 * still.light_mm + 0.5
    assert bent.poses < 40 or bent.turn_deg > 0.5
    assert 2.0 < still.nees < 12.0
    assert 2.0 < timed.nees < 12.0


def test_times_must_be_one_for_each_light(laboratory):
    with pytest.raises(ValueError, match="times_s"):
        MultiplexedTracker(StereoTracker(laboratory.rig, laboratory.leds), [0.0, 0.1])
