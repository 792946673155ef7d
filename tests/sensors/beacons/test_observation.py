"""A reflector observation as a measurement of the filter and as a line of JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rendezview.fusion.logs import LogContext, read_record
from rendezview.geometry.pose import Pose
from rendezview.io.results import json_line
from rendezview.sensors.beacons import (
    ReflectorSensor,
    SixNumbers,
    TrackingOptions,
    patterns_of,
    pose_of,
)
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.observation import Observation

MOUNT = Pose.identity().perturbed([0.1, -0.2, 0.3, 0.5, 0.0, -0.4])


@pytest.mark.parametrize("mounts", [{}, {"reflectors": MOUNT}])
def test_a_measurement_is_the_one_that_the_log_gives(client, picture, paper_camera, mounts):
    patterns = patterns_of(client)
    sensor = ReflectorSensor(paper_camera, patterns, tracking=TrackingOptions(confirm=False))
    pose = pose_of(SixNumbers(9.0, 0.0, 0.0, 2.9, 0.05, 0.05), patterns[1])
    frames = picture(merged(patterns), pose, np.random.default_rng(30))
    observation = sensor.update(2.5, frames)
    assert isinstance(observation, Observation)
    assert not observation.roll_ambiguous
    direct = observation.measurement("reflectors", mount=mounts.get("reflectors"))
    line = json.loads(json_line(observation.record()))
    read = read_record(line, "pose", "reflectors", LogContext(mounts=mounts), "line")
    assert direct.time_s == read.time_s == 2.5
    assert direct.sensor == read.sensor == "reflectors"
    np.testing.assert_allclose(direct.pose.rotation, read.pose.rotation, atol=1e-14)
    np.testing.assert_allclose(direct.pose.translation_m, read.pose.translation_m, atol=1e-14)
    np.testing.assert_allclose(direct.covariance, read.covariance, rtol=1e-9, atol=1e-18)


def test_an_ambiguous_roll_is_no_measurement(picture, three, paper_camera):
    sensor = ReflectorSensor(paper_camera, [three], tracking=TrackingOptions(confirm=False))
    six = SixNumbers(3.0, 0.03, -0.02, 0.2, 0.15, -0.1)
    observation = sensor.update(0.0, picture(three, six, np.random.default_rng(31)))
    assert observation.pose is not None
    assert observation.roll_ambiguous
    assert observation.measurement("reflectors") is None
    assert replace(observation, roll_ambiguous=False).measurement("reflectors") is not None
