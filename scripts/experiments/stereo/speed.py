"""Readings a second of the stereo LED tracker, from currents to a pose with covariance."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count

import numpy as np
from rendezview.sensors.stereo import MotionOptions, Rig, StereoTracker, TrackerOptions, reprocess
from rendezview.sensors.stereo.laboratory import calibrate_laboratory
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions
from rich.table import Table

from experiments.frame import show
from rendezview.io.target import Target

READINGS = 4100
REPEATS = 25
LOG_TIMES = 4


def run(*, target: str = "models_cad/scole", seed: int = 21) -> None:
    """Readings a second of the stereo LED tracker, from currents to a pose with covariance.

    One core, best and median of repeated runs in one process: wall clock, and processor time for
    shared machines. The peer is the paper's solver in plain numpy (one iteration a reading).
    """
    craft = Target.load(target)
    leds = np.array([led.position_m for led in craft.leds])
    rig, currents = laboratory_run(leds, seed)
    log = np.concatenate([currents] * LOG_TIMES)
    table = Table("what", "wall µs, best / median", "CPU µs", "a second (wall)", "(CPU)")
    for name, motion in (("tracker", None), ("tracker with filter", MotionOptions())):
        follow = following(rig, craft, currents, TrackerOptions(motion=motion))
        _row(table, name, follow, len(currents))
    tracker = StereoTracker.of_target(rig, craft)
    _row(table, "log at once", lambda: reprocess(tracker, log), len(log))
    few = currents[:410]
    _row(table, "plain numpy, one iteration", lambda: plain(rig, leds, few), len(few))
    print(
        f"seed {seed}; {READINGS} readings of {len(leds)} lights in {len(rig)} cameras; "
        f"log of {len(log)}; {reprocess(tracker, log).ok.sum()} of them with a pose"
    )
    show(table, width=100)


def laboratory_run(leds: np.ndarray, seed: int) -> tuple[Rig, np.ndarray]:
    """A calibrated rig, and its currents while the lights turn to and fro."""
    laboratory = Laboratory(leds, LaboratoryOptions(), seed)
    rng = np.random.default_rng(seed)
    angles = np.deg2rad(40.0) * np.sin(np.arange(READINGS) * np.deg2rad(2.0) / np.deg2rad(40.0))
    currents = laboratory.currents(laboratory.stage(angles), rng)
    return calibrate_laboratory(laboratory.calibration(rng)).rig, currents


def following(
    rig: Rig, target: Target, currents: np.ndarray, options: TrackerOptions
) -> Callable[[], None]:
    """All readings, one after the other; time goes on from call to call."""
    tracker, clock = StereoTracker.of_target(rig, target, options), count()

    def follow() -> None:
        for reading in currents:
            spots = [
                camera.photodiode.read(row)
                for camera, row in zip(rig.cameras, reading, strict=True)
            ]
            tracker.update(0.1 * next(clock), spots)

    return follow


def _row(table: Table, name: str, call: Callable[[], object], readings: int) -> None:
    call()
    wall, cpu = [], []
    for _ in range(REPEATS):
        start, used = time.perf_counter(), time.process_time()
        call()
        wall.append(1e6 * (time.perf_counter() - start) / readings)
        cpu.append(1e6 * (time.process_time() - used) / readings)
    table.add_row(
        name,
        f"{min(wall):.2f} / {np.median(wall):.2f}",
        f"{min(cpu):.2f} / {np.median(cpu):.2f}",
        f"{1e6 / min(wall):,.0f}",
        f"{1e6 / min(cpu):,.0f}",
    )


def plain(rig: Rig, leds: np.ndarray, currents: np.ndarray) -> None:
    """Eq. 4 linearised by numpy: 24 equations, one iteration from the last estimate."""
    rotation, translation = np.eye(3), np.zeros(3)
    for reading in currents:
        rows, right = [], []
        for camera, light in zip(rig.cameras, reading, strict=True):
            ideal, _ = camera.ideal(camera.photodiode.read(light))
            arm = leds @ rotation.T
            c = camera.camera_from_rig
            p = (arm + translation) @ c.rotation.T + c.translation_m
            for axis in range(2):
                x = p[:, axis] / p[:, 2]
                g = (c.rotation[axis] - x[:, None] * c.rotation[2]) / p[:, 2:]
                rows.append(np.hstack([np.cross(arm, g), g]))
                right.append(ideal[:, axis] - x)
        step, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)
        translation = translation + step[3:]
        x, y, z = step[:3]
        turn = np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        u, _, vt = np.linalg.svd(turn @ rotation)
        rotation = u @ vt
