"""Lights that shine one after the other: a turning target is read at one time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between
from rendezview.io.target import Target
from rendezview.sensors.observation import Status
from rendezview.sensors.stereo import StereoTracker
from rendezview.sensors.stereo.multiplex import MultiplexedTracker
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions

SCOLE = Path(__file__).resolve().parents[3] / "models_cad" / "scole"
SLOT_S = 1.0 / 60.0


@pytest.fixture(scope="module")
def laboratory() -> Laboratory:
    leds = np.array([led.position_m for led in Target.load(SCOLE).leds])
    options = LaboratoryOptions(signal_to_noise=4000.0, distorted=False)
    return Laboratory(leds, options, seed=5)


def turning(rate_rad_s: float):
    """rig_from_target of a stage that turns and moves a little."""

    def at(time_s: float) -> Pose:
        turn = Rotation.from_rotvec([0.0, 0.0, rate_rad_s * time_s]).as_matrix()
        return Pose(turn, np.array([0.1 * np.sin(0.5 * time_s), 0.0, 0.0]))

    return at


def errors(laboratory: Laboratory, rate_deg_s: float, corrected: bool):
    """Rotation errors, rad, farthest light, m, and squared normalised errors, after 1 s."""
    at, rng = turning(np.deg2rad(rate_deg_s)), np.random.default_rng(3)
    plain = StereoTracker(laboratory.rig, laboratory.leds)
    offsets = SLOT_S * np.arange(len(laboratory.leds))
    tracker = MultiplexedTracker(plain, offsets) if corrected else plain
    first, turns, lights, nees, known = laboratory.rig.cameras[0].camera_from_rig, [], [], [], 0
    for k in range(40):
        currents = laboratory.scan(at, 0.1 * k + offsets, rng)
        spots = [
            camera.photodiode.read(seen)
            for camera, seen in zip(laboratory.rig.cameras, currents, strict=True)
        ]
        found = tracker.update(0.1 * k, spots)
        if found.status is not Status.OK:
            continue
        known += 1
        truth = first @ at(0.1 * k)
        off = np.append(
            between(found.pose.rotation, truth.rotation),
            found.pose.translation_m - truth.translation_m,
        )
        if k >= 10:
            turns.append(np.linalg.norm(off[:3]))
            apart = found.pose.apply(laboratory.leds) - truth.apply(laboratory.leds)
            lights.append(np.linalg.norm(apart, axis=1).max())
            nees.append(off @ np.linalg.solve(found.covariance, off))
    return np.median(turns), np.median(lights), np.mean(nees), known


def test_a_scan_of_a_turning_target_is_read_at_its_beginning(laboratory):
    still = errors(laboratory, 0.0, corrected=True)
    assert still[3] == 40
    bent = errors(laboratory, 20.0, corrected=False)
    turning_ = errors(laboratory, 20.0, corrected=True)
    assert turning_[3] == 40
    assert np.rad2deg(turning_[0]) < 0.1
    assert turning_[1] < 2.0 * still[1] + 5e-4
    assert bent[3] < 40 or np.rad2deg(bent[0]) > 0.5
    assert 2.0 < still[2] < 12.0
    assert 2.0 < turning_[2] < 12.0


def test_times_must_be_one_for_each_light(laboratory):
    with pytest.raises(ValueError, match="times_s"):
        MultiplexedTracker(StereoTracker(laboratory.rig, laboratory.leds), [0.0, 0.1])
