"""Threads that share a reflector acquirer or sensor get the same bytes as one thread."""

from __future__ import annotations

import numpy as np
from tests.sensors.threads import (
    THREADS,
    assert_one_after_the_other,
    assert_shared,
    text_of,
    together,
)

from rendezview.sensors.beacons import (
    Acquirer,
    ReflectorSensor,
    SixNumbers,
    TrackingOptions,
    find_spots,
)


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

    assert_shared(bytes_of, tables, times=10)


def test_sensors_in_threads_give_the_same_observations(picture, three, paper_camera):
    rng = np.random.default_rng(41)
    frames = [picture(three, six_at(0.1 * k), rng) for k in range(12)]

    def run(_):
        sensor = ReflectorSensor(paper_camera, [three])
        return [text_of(sensor.update(0.1 * k, pair), "rates") for k, pair in enumerate(frames)]

    assert together(run, range(THREADS)) == [run(0)] * THREADS


def test_calls_on_a_shared_sensor_run_one_after_the_other(picture, three, paper_camera):
    # Without memory of a track every reading of one picture is the same.
    frames = picture(three, six_at(0.0), np.random.default_rng(42))
    options = TrackingOptions(confirm=False, coast=-1, memory=-1)
    sensor = ReflectorSensor(paper_camera, [three], tracking=options)
    assert_one_after_the_other(lambda t: text_of(sensor.update(t, frames), "rates"), 60)
