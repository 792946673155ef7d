"""An approach from 60 m to 1 m through recognizer, ring detector, laser ranger and filter."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.special import chdtri

from experiments.fusion.trials import Flight, fly, load_run, make_run
from rendezview.sensors.appearance import ViewModel

EDGES_M = (60.1, 45.0, 32.0, 22.0, 16.0, 11.0, 7.5, 5.0, 3.0, 2.0, 0.9)
NAMES = ("ring centre, mm", "depth, mm", "axis, °", "attitude, °")
SCALES = (1e3, 1e3, 180.0 / np.pi, 180.0 / np.pi)
SENSORS = ("appearance", "ring", "laser")


def rms_and_median(values: np.ndarray) -> tuple[float, float]:
    """Of the finite ones; NaN where there is none."""
    values = values[np.isfinite(values)]
    if not len(values):
        return np.nan, np.nan
    return float(np.sqrt(np.mean(values**2))), float(np.median(values))


def error_tables(flights: list[Flight]) -> None:
    """Errors of the filter and of each sensor by range; a mark where one sensor is better."""
    for k, (name, scale) in enumerate(zip(NAMES, SCALES, strict=True)):
        print(f"\n{name}: r.m.s. (median) of all frames of all seeds; received in % of frames")
        heads = " ".join(f"{sensor:>24s}" for sensor in SENSORS)
        print(f"{'range, m':>12s} {'frames':>7s} {'fused':>18s} {heads}")
        for far, near in pairwise(EDGES_M):
            chosen = [s for f in flights for s in f.samples if near <= s.range_m < far]
            fused = np.array([s.fused[k] for s in chosen]) * scale
            own, middle = rms_and_median(fused)
            line, singles = f"{own:9.3f} ({middle:7.3f})", []
            for sensor in SENSORS:
                got = np.array([s.single[sensor][k] for s in chosen if sensor in s.single]) * scale
                rms, median = rms_and_median(got)
                share = 100.0 * np.isfinite(got).sum() / len(chosen)
                if share >= 50.0:
                    singles.append(rms)
                cell = f"{rms:9.3f} ({median:7.3f}) {share:3.0f}%"
                line += f" {cell if share else '–':>24s}"
            if missing := int(np.isnan(fused).sum()):
                line += f"  {missing} without a state"
            mark = "" if not singles or own <= min(singles) else "  > best single"
            print(f"{far:5.1f}–{near:5.1f} {len(chosen):8d} {line}{mark}")


def consistency_table(flights: list[Flight]) -> None:
    """Normalised errors by range beside their 95 % bands."""
    count = len(flights)
    low, high = chdtri(6 * count, 0.975) / count, chdtri(6 * count, 0.025) / count
    one_low, one_high = chdtri(6, 0.975), chdtri(6, 0.025)
    print(
        f"\nnormalised error squared (6): one sample of each seed at the middle of the bin, mean "
        f"of {count} with its 95 % band {low:.2f}–{high:.2f}; share of all frames within the band "
        f"of one ({one_low:.2f}–{one_high:.2f}), above it"
    )
    for far, near in pairwise(EDGES_M):
        inside = [[s.nees for s in f.samples if near <= s.range_m < far] for f in flights]
        every = np.concatenate(inside)
        mean = float(np.mean([some[len(some) // 2] for some in inside if some]))
        within = 100.0 * np.mean((every >= one_low) & (every <= one_high))
        verdict = "in" if low <= mean <= high else ("below" if mean < low else "above")
        above = 100.0 * np.mean(every > one_high)
        print(f"{far:5.1f}–{near:5.1f} {mean:6.2f} {verdict:5s} {within:5.1f} % {above:5.1f} %")


def run(
    runs: Annotated[Path, "folder of the runs, kept"], *,
    model: Annotated[Path | None, "view model of the client; for new runs"] = None,
    seeds: int = 50, samples: Annotated[Path | None, "every sample, for pictures fusion"] = None,
) -> None:  # fmt: skip
    """An approach from 60 m to 1 m through recognizer, ring detector, laser ranger and filter.

    Every seed is another approach: motion, Sun (10–40° from behind the camera), roll, noise. Frames
    are rendered, and the recognizer and the ring detector run on them as the commands do. RUNS
    keeps their logs: a second call only joins them. The filter is that of rendezview fuse.
    """
    views = ViewModel.load(model) if model else None
    flights = []
    for seed in range(seeds):
        make_run(runs / str(seed), seed, views)
        flight = fly(load_run(runs / str(seed)))
        flights.append(flight)
        print(f"seed {seed}: {len(flight.samples)} frames, {flight.without_state} without a state, "
              f"begun {flight.starts}, lock-outs {flight.lockouts}", flush=True)  # fmt: skip
    error_tables(flights)
    consistency_table(flights)
    print(f"\n{seeds} approaches: frames without a state "
          f"{sum(f.without_state for f in flights)}; restarted "
          f"{sum(f.starts > 1 for f in flights)}")  # fmt: skip
    if samples:
        rows = [
            {"range_m": s.range_m, "fused": s.fused.tolist(),
             "single": {name: errors.tolist() for name, errors in s.single.items()}}
            for f in flights for s in f.samples
        ]  # fmt: skip
        samples.write_text(json.dumps(rows))
