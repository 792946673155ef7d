"""An approach from 60 m to 1 m through recognizer, ring detector, laser ranger and filter."""

from __future__ import annotations

from itertools import pairwise
from json import dumps
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.special import chdtri

from experiments.fusion.trials import OPTIONS, Flight, fly, load_run, make_run
from rendezview.sensors.appearance import ViewModel

EDGES_M = (60.1, 45.0, 32.0, 22.0, 16.0, 11.0, 7.5, 5.0, 3.0, 2.0, 0.9)
NAMES = ("ring centre, mm", "depth, mm", "axis, °", "attitude, °")
SCALES = (1e3, 1e3, 180.0 / np.pi, 180.0 / np.pi)


def rms(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def median(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else np.nan


def tables(flights: list[Flight]) -> None:
    """Errors and consistency by range."""
    sensors = ("appearance", "ring", "laser")
    bins = list(pairwise(EDGES_M))
    for k, (name, scale) in enumerate(zip(NAMES, SCALES, strict=True)):
        print(f"\n{name}: r.m.s. (median) of all frames of all seeds; received in % of frames")
        heads = " ".join(f"{sensor:>24s}" for sensor in sensors)
        print(f"{'range, m':>12s} {'frames':>7s} {'fused':>18s} {heads}")
        for far, near in bins:
            chosen = [s for f in flights for s in f.samples if near <= s.range_m < far]
            fused = np.array([s.fused[k] for s in chosen]) * scale
            cells = []
            singles = []
            for sensor in sensors:
                got = [s.single[sensor][k] * scale for s in chosen if sensor in s.single]
                values = np.array(got)
                values = values[np.isfinite(values)]
                if len(values) == 0:
                    cells.append(f"{'–':>24s}")
                    continue
                share = 100.0 * len(values) / len(chosen)
                if share >= 50.0:
                    singles.append(rms(values))
                cells.append(f"{rms(values):9.3f} ({np.median(values):7.3f}) {share:3.0f}%")
            missing = int(np.isnan(fused).sum())
            mark = "" if not singles or rms(fused) <= min(singles) else "  > best single"
            if missing:
                mark += f"  {missing} without a state"
            own = f"{rms(fused):9.3f} ({median(fused):7.3f})"
            print(f"{far:5.1f}–{near:5.1f} {len(chosen):8d} {own} " + " ".join(cells) + mark)
    count = len(flights)
    low, high = chdtri(6 * count, 0.975) / count, chdtri(6 * count, 0.025) / count
    one_low, one_high = chdtri(6, 0.975), chdtri(6, 0.025)
    print(
        f"\nnormalised error squared (6): one sample of each seed at the middle of the bin, mean "
        f"of {count} with its 95 % band {low:.2f}–{high:.2f}; share of all frames within the band "
        f"of one ({one_low:.2f}–{one_high:.2f}), above it"
    )
    for far, near in bins:
        means, every = [], []
        for flight in flights:
            inside = [s for s in flight.samples if near <= s.range_m < far]
            every += [s.nees for s in inside]
            if inside:
                means.append(inside[len(inside) // 2].nees)
        values = np.array(every)
        mean = float(np.mean(means))
        within = np.mean((values >= one_low) & (values <= one_high))
        above = np.mean(values > one_high)
        verdict = "in" if low <= mean <= high else ("below" if mean < low else "above")
        shares = f"{100 * within:5.1f} % {100 * above:5.1f} %"
        print(f"{far:5.1f}–{near:5.1f} {mean:6.2f} {verdict:5s} {shares}")


def run(
    runs: Annotated[Path, "folder of the runs, kept"], *,
    model: Annotated[Path | None, "view model of the client; for new runs"] = None,
    first_seed: int = 0, seeds: int = 50, keep_frames: Annotated[bool, "1 MB a frame"] = False,
    json: Annotated[Path | None, "write every sample too"] = None,
) -> None:  # fmt: skip
    """An approach from 60 m to 1 m through recognizer, ring detector, laser ranger and filter.

    Every seed is another approach: motion, Sun (10–40° from behind the camera), roll, noise. Frames
    are rendered, and the recognizer and the ring detector run on them as the commands do. RUNS
    keeps their logs: a second call only joins them. The filter is that of rendezview fuse.
    """
    views = ViewModel.load(model) if model else None
    flights = []
    numbers = range(first_seed, first_seed + seeds)
    for seed in numbers:
        folder = runs / str(seed)
        make_run(folder, seed, views, keep_frames=keep_frames)
        flight = fly(load_run(folder), OPTIONS)
        flights.append(flight)
        unheard = sum(np.isnan(s.fused[0]) for s in flight.samples)
        print(
            f"seed {seed}: {len(flight.samples)} frames, {unheard} without a state, begun "
            f"{flight.starts}, largest step at a hand-over {flight.jumps['hand-over']:.2f} σ, "
            f"anywhere {flight.jumps['any']:.2f} σ, lock-outs {flight.lockouts}",
            flush=True,
        )
    tables(flights)
    lost = sum(np.isnan(s.fused[0]) for f in flights for s in f.samples)
    print(
        f"\n{len(flights)} approaches, seeds {numbers.start} to {numbers.stop - 1}: frames without "
        f"a state {lost}; restarted {sum(f.starts > 1 for f in flights)}; largest step at a "
        f"hand-over {max(f.jumps['hand-over'] for f in flights):.2f} σ, of any update "
        f"{max(f.jumps['any'] for f in flights):.2f} σ"
    )
    if json:
        rows = [
            {"seed": seed, "time_s": s.time_s, "range_m": s.range_m, "nees": s.nees,
             "fused": s.fused.tolist(), "sigma_m": s.sigma_m,
             "single": {n: v.tolist() for n, v in s.single.items()}}
            for seed, f in zip(numbers, flights, strict=True) for s in f.samples
        ]  # fmt: skip
        json.write_text(dumps(rows))
