"""An approach from 60 m to 1 m through recognizer, ring detector, laser ranger and filter."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.special import chdtri

from experiments.frame import show, table_of
from experiments.fusion.fly_sensors import measure
from experiments.fusion.trials import Flight, fly, load_run, make_run
from rendezview.sensors.appearance import ViewModel

EDGES_M = (60.1, 45.0, 32.0, 22.0, 16.0, 11.0, 7.5, 5.0, 3.0, 2.0, 0.9)
NAMES = ("ring centre, mm", "depth, mm", "axis, °", "attitude, °")
SCALES = (1e3, 1e3, 180.0 / np.pi, 180.0 / np.pi)
SENSORS = ("appearance", "ring", "laser")


def rms_and_median(values: list[float]) -> tuple[float, float, int]:
    """Of the finite ones, and how many; NaN where there is none."""
    finite = np.array(values)[np.isfinite(values)]
    if not len(finite):
        return np.nan, np.nan, 0
    return float(np.sqrt(np.mean(finite**2))), float(np.median(finite)), len(finite)


def error_tables(flights: list[Flight]) -> None:
    """Errors of the filter and of each sensor by range."""
    nowhere = np.full(len(NAMES), np.nan)
    for k, (name, scale) in enumerate(zip(NAMES, SCALES, strict=True)):
        title = f"{name}: r.m.s. (median) of all frames; answered in % of frames"
        table = table_of(title, ("range, m", "frames", "fused", *SENSORS))
        for far, near in pairwise(EDGES_M):
            chosen = [s for f in flights for s in f.samples if near <= s.range_m < far]
            cells = []
            for sensor in (None, *SENSORS):
                each = [s.single.get(sensor, nowhere) if sensor else s.fused for s in chosen]
                rms, median, count = rms_and_median([scale * error[k] for error in each])
                share = f"{100.0 * count / max(len(chosen), 1):.0f} %"
                cells.append(f"{rms:.3f} ({median:.3f}) {share}" if count else "–")
            table.add_row(f"{far:g}–{near:g}", str(len(chosen)), *cells)
        show(table, width=120)


def consistency_table(flights: list[Flight]) -> None:
    """Normalised errors by range beside their 95 % bands."""
    count = len(flights)
    low, high = chdtri(6 * count, 0.975) / count, chdtri(6 * count, 0.025) / count
    title = f"normalised error squared (6), one frame a seed; 95 %: {low:.2f}–{high:.2f}"
    table = table_of(title, "range, m | mean")
    for far, near in pairwise(EDGES_M):
        inside = [[s.nees for s in f.samples if near <= s.range_m < far] for f in flights]
        mean = float(np.mean([some[len(some) // 2] for some in inside if some]))
        table.add_row(f"{far:g}–{near:g}", f"{mean:.2f}")
    show(table)


def run(
    runs: Annotated[Path, "folder of the runs, kept"],
    model: Annotated[Path, "view model of the client"], *,
    seeds: int = 50, flights: int = 0, jobs: int = 1,
) -> None:  # fmt: skip
    """An approach from 60 m to 1 m through recognizer, ring detector, laser ranger and filter.

    Every seed is another approach: motion, Sun (10–40° from behind the camera), roll, noise. Frames
    are rendered, and the recognizer and the ring detector run on them as the commands do. RUNS
    keeps their logs: a second call only joins them. The filter is that of rendezview fuse.

    --flights 10 measures the sensors on rendered flights instead: RUNS/measured.json, the tables
    that modelled flights draw from.
    """
    views = ViewModel.load(model)
    if flights:
        runs.mkdir(parents=True, exist_ok=True)
        measure(views, runs / "measured.json", flights, 100, jobs)
        return
    flown = []
    for seed in range(seeds):
        make_run(runs / str(seed), seed, views)
        flight = fly(load_run(runs / str(seed), views))
        flown.append(flight)
        print(f"seed {seed}: {len(flight.samples)} frames, {flight.without_state} without a state, "
              f"begun {flight.starts}", flush=True)  # fmt: skip
    error_tables(flown)
    consistency_table(flown)
    print(f"\n{seeds} approaches: frames without a state "
          f"{sum(f.without_state for f in flown)}; restarted "
          f"{sum(f.starts > 1 for f in flown)}")  # fmt: skip
