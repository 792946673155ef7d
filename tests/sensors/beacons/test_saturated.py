"""Saturated reflectors, whose charge may run over: poses and their claimed errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests import plain_pictures as plain
from tests.plain_readings import HALF_TURN, PAPER, frames_of, squared_error

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorSensor, TrackingOptions


def run_over(picture, rng):
    """Charge that runs down from saturated pixels, the last of a column partly full."""
    out = picture.copy()
    for column in np.flatnonzero((picture == 255).any(axis=0)):
        full = np.concatenate([[0], (picture[:, column] == 255).astype(int), [0]])
        starts, ends = np.flatnonzero(np.diff(full) == 1), np.flatnonzero(np.diff(full) == -1)
        for start, end in zip(starts, ends, strict=True):
            last = end + round(0.25 * (end - start))
            out[end:last, column] = 255
            out[last, column] = max(out[last, column], rng.integers(20, 250))
    return out


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("runs_over", [False, True])
def test_poses_of_saturated_discs_are_as_near_as_they_claim(three, paper_camera, runs_over, even):
    """Mean normalised error squared of six numbers: 6, within chance of 24 readings."""
    rng, errors = np.random.default_rng(12), []
    look = plain.Look(peak=500.0, even=even)
    for range_m in np.tile([0.8, 1.5, 3.0, 6.0], 6):
        margin_px = min(20.0 + 0.25 * PAPER.focal_px / range_m, 186.0)
        truth = Pose(*plain.look_at(rng, PAPER, range_m, 0.5, margin_px))
        frames = frames_of(PAPER, three, truth, rng, look)
        if runs_over:
            frames = replace(frames, lit=run_over(frames.lit, rng))
        sensor = ReflectorSensor(paper_camera, [three], tracking=TrackingOptions(confirm=False))
        reading = sensor.update(0.0, frames)
        assert reading.pose is not None
        errors.append(squared_error(reading, truth, truth @ HALF_TURN))
        for window in range(2):  # tracked too
            tracked = sensor.update(1.0 + window, frames)
            assert tracked.status == "ok"
    assert 3.0 < np.mean(errors) < 10.0
