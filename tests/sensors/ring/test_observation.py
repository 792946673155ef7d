"""A ring observation as a measurement of the filter and as a line of JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rendezview.fusion.logs import LogContext, read_record
from rendezview.geometry.pose import Pose
from rendezview.io.results import json_line
from rendezview.io.target import DockingRing
from rendezview.sensors.observation import Observation, Status
from rendezview.sensors.ring import RingPrior, RingSensor

RING = DockingRing(np.array([0.1, 0.0, 0.3]), np.array([0.0, 0.0, 1.0]), 0.6)
MOUNT = Pose.identity().perturbed([0.1, -0.2, 0.3, 0.5, 0.0, -0.4])


@pytest.mark.parametrize("mounts", [{}, {"ring": MOUNT}])
def test_a_measurement_is_the_one_that_the_log_gives(make, ring_camera, mounts):
    counts = set()
    for seed in range(4):
        scene, image = make([20, seed], tilt_rad=(0.0, 0.7))
        observation = RingSensor(ring_camera, scene.ring.radius_m).update(3.5, image)
        direct = observation.measurement("ring", ring=RING, mount=mounts.get("ring"))
        line = json.loads(json_line(observation.record()))
        read = read_record(line, "ring", "ring", LogContext(RING, mounts=mounts), "line")
        assert (direct.time_s, direct.sensor, direct.ring) == (3.5, "ring", RING)
        assert (direct.time_s, direct.sensor, direct.ring) == (read.time_s, read.sensor, read.ring)
        np.testing.assert_array_equal(direct.centres_m, read.centres_m)
        np.testing.assert_array_equal(direct.axes, read.axes)
        np.testing.assert_array_equal(direct.covariances, read.covariances)
        counts.add(len(direct.candidates))
    assert 2 in counts


def test_an_observation_without_circles_is_no_measurement(make, ring_camera):
    _, image = make([20, 0])
    nothing = RingSensor(ring_camera, 0.6).update(0.0, np.zeros_like(image))
    ellipses = RingSensor(ring_camera).update(0.0, image)
    for observation in (nothing, ellipses):
        assert isinstance(observation, Observation)
        assert observation.pose is None
        assert observation.measurement("ring", ring=RING) is None


def test_a_measurement_needs_the_ring_and_a_time(make, ring_camera):
    scene, image = make([20, 0])
    observation = RingSensor(ring_camera, scene.ring.radius_m).update(0.0, image)
    with pytest.raises(ValueError, match="place on the target"):
        observation.measurement("ring")


def test_frames_come_in_order_of_time(make, ring_camera):
    scene, image = make([20, 0])
    sensor = RingSensor(ring_camera, scene.ring.radius_m)
    prior = RingPrior(axis=scene.ring.axis)
    assert sensor.update(1.0, image, prior).status is Status.OK
    for time_s in (1.0, 0.5, float("nan")):
        with pytest.raises(ValueError, match="order of time"):
            sensor.update(time_s, image, prior)
    sensor.reset()
    assert sensor.update(0.5, image, prior).time_s == 0.5
