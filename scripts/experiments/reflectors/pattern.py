"""Self-calibration of a pattern from runs: its places, their σ, and which reflector is named."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from experiments.frame import nees, show, table_of, two
from experiments.reflectors import lab
from experiments.reflectors.lab import plain
from rendezview import Pose, ReflectorSensor
from rendezview.calibration.pattern import loosened, measure_pattern, sightings_of_readings

# mm: by how much one reflector is off, and σ of all; whether the file states the latter.
ROWS = ((0.0, 0.0, False), (0.0, 0.1, True), (1.0, 0.0, False), (3.0, 0.0, False),
        (1.0, 0.1, True), (3.0, 0.1, True))  # fmt: skip


def approach(rng: np.random.Generator, readings: int) -> Iterator[Pose]:
    """From 3 to 5 m to 0.4 of that; the target sways by ±23° about two axes and rolls a little."""
    phase, start_m, roll = rng.uniform(0, 6.3, 5), rng.uniform(3.0, 5.0), rng.uniform(-0.6, 0.6)
    for t in np.arange(readings) / readings:
        sight = np.array([0.1 * math.sin(4 * t + phase[0]), 0.08 * math.sin(5 * t + phase[1]), 1.0])
        turn = plain.turn([1, 0, 0], 0.4 * math.sin(6 * t + phase[2]))
        turn = turn @ plain.turn([0, 1, 0], 0.4 * math.sin(5 * t + phase[3]))
        turn = turn @ plain.turn([0, 0, 1], roll + 0.1 * math.sin(3 * t + phase[4]))
        range_m = start_m * (1.0 - 0.6 * t)
        yield Pose(turn @ np.diag([1.0, -1.0, -1.0]), range_m * sight / np.linalg.norm(sight))


def run(*, runs: int = 100, readings: int = 30, seed: int = 7) -> None:
    """Five reflectors (base 368 mm), of which one is off: places and names after a run.

    Pictures of the tests' plain simulator, retro-reflected, noise 2 grey. NEES of a place has three
    unknowns: 3 is right. The largest of the file is over the σ that the corrected file states.
    """
    columns = "off, mm | others, mm | right | wrong | open | places, mm: off | others | NEES | file"
    table = table_of(f"{runs} runs of {readings} readings, seed {seed}", columns, left=2)
    for number, (off_mm, others_mm, stated) in enumerate(ROWS):
        named, of_off, of_others, nees_of, of_file = [], [], [], [], []
        for n in range(runs):
            rng = np.random.default_rng([seed, number, n])
            by = 1e-3 * others_mm * rng.normal(0.0, 1.0, lab.FIVE.positions_m.shape)
            which, way = int(rng.integers(5)), rng.normal(0.0, 1.0, 3)
            by[which] += 1e-3 * off_mm * way / np.linalg.norm(way)
            mounted = replace(lab.FIVE, positions_m=lab.FIVE.positions_m + by)
            sigmas = np.full(5, 1e-3 * others_mm)
            given = replace(lab.FIVE, sigmas_m=sigmas, sigmas_known=True) if stated else lab.FIVE
            sensor, read = ReflectorSensor(lab.CAMERA, loosened([given])), []
            for k, pose in enumerate(approach(rng, readings)):
                placed = pose.rotation, pose.translation_m
                frames = lab.pictures("plain", mounted, placed, plain.Look(), rng)
                read.append(sensor.update(0.5 * k, frames))
            found = measure_pattern(lab.CAMERA, [given], sightings_of_readings(read, given))
            wanted = {given.names[which]} if off_mm else set()
            right = set(found.named) == wanted
            named.append("right" if right else "wrong" if set(found.named) - wanted else "open")
            error = found.moved_m - by
            for k in range(5):
                (of_off if off_mm and k == which else of_others).append(np.linalg.norm(error[k]))
                own = slice(3 * k, 3 * k + 3)
                nees_of.append(nees(error[k], found.covariance[own, own]))
                of_file.append(error[k] @ error[k] / found.pattern.sigmas_m[k] ** 2)
        counts = [str(named.count(word)) for word in ("right", "wrong", "open")]
        sizes = [two(1e3 * np.array(e)) if e else "" for e in (of_off, of_others)]
        means = [f"{np.mean(values):.1f}" for values in (nees_of, of_file)]
        table.add_row(f"{off_mm:g}", f"{others_mm:g}", *counts, *sizes, *means)
    show(table, width=110)
    print("places: median and 95 % of the errors")
