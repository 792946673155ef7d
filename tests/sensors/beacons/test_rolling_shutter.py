"""Rows that are exposed one after the other: a turning target is not bent by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests import plain_pictures as plain
from tests.plain_readings import CAMERA, HALF_TURN, PINHOLE, frames_of, squared_error

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorSensor, TrackingOptions
from rendezview.sensors.beacons.detect.rolling_shutter import at_middle_row
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS, SIGMA, X, Y

READOUT_S, STEP_S, TURN = 0.033, 0.1, np.radians(20.0)
START = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.03, -0.05, 2.0]))


def pose_at(time_s: float) -> Pose:
    return START.perturbed([0.1 * TURN * time_s, 0.0, TURN * time_s, 0.02 * time_s, 0.0, 0.0])


def pictures(five, time_s, rng):
    """Every disc where it is when its own row is exposed."""
    places, normals = np.empty((5, 3)), np.empty((5, 3))
    for k in range(5):
        late = 0.0
        for _ in range(5):
            pose = pose_at(time_s + late)
            places[k], normals[k] = pose.apply(five.positions_m[k]), pose.rotation @ five.normals[k]
            late = READOUT_S * (PINHOLE.project(places[k : k + 1])[0, 1] / 383.0 - 0.5)
    seen = replace(five, positions_m=places, normals=normals)
    return frames_of(PINHOLE, seen, Pose.identity(), rng, plain.Look(even=True))


def test_a_turning_target_is_off_by_what_its_pose_claims(five):
    rng, ends = np.random.default_rng(1), {}
    readings = [(k * STEP_S, pictures(five, k * STEP_S, rng)) for k in range(16)]
    for readout_s in (READOUT_S, 0.0):
        sensor = ReflectorSensor(CAMERA, [five], tracking=TrackingOptions(readout_s=readout_s))
        nees = []
        for time_s, frames in readings:
            found, truth = sensor.update(time_s, frames), pose_at(time_s)
            if found.pose is None:
                continue
            nees.append(squared_error(found, truth, truth @ HALF_TURN))
        ends[readout_s] = nees
    assert len(ends[READOUT_S]) >= 14
    assert np.mean(ends[READOUT_S]) < 9.0
    assert np.mean(ends[0.0]) > 5.0 * np.mean(ends[READOUT_S])


def test_spots_of_constant_speed_are_where_they_were_at_the_middle_row():
    speed, step_s = np.array([120.0, -40.0]), 0.1
    start = np.array([[100.0, 20.0], [250.0, 190.0], [400.0, 370.0]])
    exact, table = start + speed * step_s, np.zeros((3, COLUMNS))
    # v = v₀ + speed · late, late = readout (v / 383 − 1 / 2)
    late = READOUT_S * (exact[:, 1] / 383.0 - 0.5) / (1.0 - READOUT_S * speed[1] / 383.0)
    table[:, [X, Y]], table[:, SIGMA] = exact + speed * late[:, None], 0.01
    before = start.copy()
    before[1] = np.nan  # as fast as the others
    at_middle_row(table, before, step_s, READOUT_S, 384)
    np.testing.assert_allclose(table[:, [X, Y]], exact, atol=1e-9)
    assert table[0, SIGMA] > table[1, SIGMA] >= 0.01
    nothing = table.copy()
    at_middle_row(table, np.full((3, 2), np.nan), step_s, READOUT_S, 384)
    np.testing.assert_array_equal(table, nothing)


def test_a_read_out_time_must_be_a_time():
    with pytest.raises(RendezviewError, match="readout_s"):
        TrackingOptions(readout_s=-0.1)
