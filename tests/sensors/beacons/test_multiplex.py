"""Lights that shine one after the other: a turning target is read at one time."""

from __future__ import annotations

import pytest

from experiments.stereo.multiplex import errors, laboratory_of
from rendezview.sensors.beacons import StereoTracker
from rendezview.sensors.beacons.multiplex import MultiplexedTracker
from rendezview_ground.simulate.led_laboratory import Laboratory


@pytest.fixture(scope="module")
def laboratory() -> Laboratory:
    return laboratory_of(4000.0, seed=5)


def test_a_scan_of_a_turning_target_is_read_at_its_beginning(laboratory):
    still = errors(laboratory, 0.0, True, 40, seed=3)
    bent = errors(laboratory, 20.0, False, 40, seed=3)
    timed = errors(laboratory, 20.0, True, 40, seed=3)
    assert still.poses == timed.poses == 40
    assert timed.turn_deg < 0.1
    assert timed.light_mm < 2.0 * still.light_mm + 0.5
    assert bent.poses < 40 or bent.turn_deg > 0.5
    assert 2.0 < still.nees < 12.0
    assert 2.0 < timed.nees < 12.0


def test_times_must_be_one_for_each_light(laboratory):
    with pytest.raises(ValueError, match="times_s"):
        MultiplexedTracker(StereoTracker(laboratory.rig, laboratory.leds), [0.0, 0.1])
