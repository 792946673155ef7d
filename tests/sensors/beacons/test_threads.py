"""Threads that share a reflector acquirer or sensor get the same bytes as one thread."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rendezview.io.results import json_line
from rendezview.sensors.beacons import (
    Acquirer,
    ReflectorSensor,
    SixNumbers,
    TrackingOptions,
    find_spots,
)

THREADS = 4


def text_of(observation):
    line = observation.record()
    for key in ("stage_ms", "time_s", "rates"):
        del line[key]
    return json_line(line)


def six_at(t):
    return SixNumbers(4.0 - 0.1 * t, 0.02 * t, 0.0, 0.2 + 0.02 * t, 0.15, -0.1)


def test_a_shared_acquirer_finds_the_same_poses(picture, three, paper_camera):
    rng = np.random.default_rng(40)
    tables = [find_spots(picture(three, six_at(1.0 * k), rng)) for k in range(8)]
    acquirer = Acquirer(paper_camera, [three])

    def bytes_of(spots):
        refined = acquirer.acquire(spots).refined
        pose = refined.camera_from_target
        return (
            pose.rotation.tobytes(), pose.translation_m.tobytes(), refined.covariance.tobytes()
        )  # fmt: skip

    serial = [bytes_of(spots) for spots in tables]
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in range(10):
            assert list(pool.map(bytes_of, tables)) == serial


def test_sensors_in_threads_give_the_same_observations(picture, three, paper_camera):
    rng = np.random.default_rng(41)
    frames = [picture(three, six_at(0.1 * k), rng) for k in range(12)]

    def run(_):
        sensor = ReflectorSensor(paper_camera, [three])
        return [text_of(sensor.update(0.1 * k, pair)) for k, pair in enumerate(frames)]

    serial = run(0)
    with ThreadPoolExecutor(THREADS) as pool:
        assert list(pool.map(run, range(THREADS))) == [serial] * THREADS


def test_calls_on_a_shared_sensor_run_one_after_the_other(picture, three, paper_camera):
    # Without memory of a track every reading of one picture is the same.
    frames = picture(three, six_at(0.0), np.random.default_rng(42))
    options = TrackingOptions(confirm=False, coast=-1, memory=-1)
    sensor = ReflectorSensor(paper_camera, [three], tracking=options)
    serial = text_of(sensor.update(0.0, frames))
    taken, refused = [], []

    def look(k):
        try:
            taken.append(text_of(sensor.update(1.0 + k, frames)))
        except ValueError:  # a later reading came first
            refused.append(k)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(look, range(60)))
    assert len(taken) + len(refused) == 60
    assert taken
    assert set(taken) == {serial}
