"""Threads that share a ring detector or sensor get the same bytes as one thread."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from rendezview.io.results import json_line
from rendezview.sensors.ring import RingDetector, RingPrior, RingSensor

THREADS = 4


def text_of(observation):
    line = observation.record()
    del line["stage_ms"], line["time_s"]
    return json_line(line)


@pytest.fixture
def scenes(make):
    return [make([30, seed], clutter=seed % 3) for seed in range(8)]


def test_a_shared_detector_gives_the_same_ellipses(scenes, ring_camera):
    detector = RingDetector(ring_camera)

    def bytes_of(image):
        edges = detector.detect(image).edges
        return [(e.ellipse.shape.tobytes(), e.ellipse.covariance.tobytes(), e.score) for e in edges]

    images = [image for _, image in scenes]
    serial = [bytes_of(image) for image in images]
    assert sum(map(len, serial)) > len(images)
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in range(3):
            assert list(pool.map(bytes_of, images)) == serial


def test_sensors_in_threads_give_the_same_observations(scenes, ring_camera):
    def run(_):
        sensor = RingSensor(ring_camera, 0.6)
        return [text_of(sensor.update(float(k), image)) for k, (_, image) in enumerate(scenes)]

    serial = run(0)
    with ThreadPoolExecutor(THREADS) as pool:
        assert list(pool.map(run, range(THREADS))) == [serial] * THREADS


def test_calls_on_a_shared_sensor_run_one_after_the_other(scenes, ring_camera):
    scene, image = scenes[0]
    prior = RingPrior(centre_m=scene.ring.centre_m, axis=scene.ring.axis)
    sensor = RingSensor(ring_camera, scene.ring.radius_m)
    serial = text_of(sensor.update(0.0, image, prior))
    taken, refused = [], []

    def look(k):
        try:
            taken.append(text_of(sensor.update(1.0 + k, image, prior)))
        except ValueError:  # a later frame came first
            refused.append(k)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(look, range(24)))
    assert len(taken) + len(refused) == 24
    assert taken
    assert set(taken) == {serial}
