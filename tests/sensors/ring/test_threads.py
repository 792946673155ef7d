"""Threads that share a ring detector or sensor get the same bytes as one thread."""

from __future__ import annotations

import pytest
from tests.sensors.threads import (
    THREADS,
    assert_one_after_the_other,
    assert_shared,
    text_of,
    together,
)

from rendezview.sensors.ring import RingDetector, RingPrior, RingSensor


@pytest.fixture
def scenes(make):
    return [make([30, seed], clutter=seed % 3) for seed in range(8)]


def test_a_shared_detector_gives_the_same_ellipses(scenes, ring_camera):
    detector = RingDetector(ring_camera)

    def bytes_of(image):
        edges = detector.detect(image).edges
        return [(e.ellipse.shape.tobytes(), e.ellipse.covariance.tobytes(), e.score) for e in edges]

    serial = assert_shared(bytes_of, [image for _, image in scenes])
    assert sum(map(len, serial)) > len(scenes)


def test_sensors_in_threads_give_the_same_observations(scenes, ring_camera):
    def run(_):
        sensor = RingSensor(ring_camera, 0.6)
        return [text_of(sensor.update(float(k), image)) for k, (_, image) in enumerate(scenes)]

    assert together(run, range(THREADS)) == [run(0)] * THREADS


def test_calls_on_a_shared_sensor_run_one_after_the_other(scenes, ring_camera):
    scene, image = scenes[0]
    prior = RingPrior(centre_m=scene.ring.centre_m, axis=scene.ring.axis)
    sensor = RingSensor(ring_camera, scene.ring.radius_m)
    assert_one_after_the_other(lambda t: text_of(sensor.update(t, image, prior)), 24)
