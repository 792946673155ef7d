"""The ring's radius and depth as states of the filter, while approaches go on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np

from experiments.fusion.trials import OPTIONS, load_run, make_run, ring_of_client
from rendezview.fusion import Fusion, Measurement, RingMeasurement
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.measurement import RingCandidate

RADIUS_SIGMA = 0.03  # of what is told of the ring: relative
DEPTH_SIGMA_M = 0.10
RANGES_M = (30.0, 16.0, 8.0, 4.0, 2.0, 1.2)


def told(measurement: Measurement, ring: DockingRing, scale: float) -> Measurement:
    """A reading of the same ellipse by someone who takes the ring for ``scale`` as large."""
    if not isinstance(measurement, RingMeasurement):
        return measurement
    candidates = []
    for c in measurement.candidates:
        spread = np.diag([scale] * 3 + [1.0] * 3)
        candidates.append(RingCandidate(scale * c.centre_m, c.axis, spread @ c.covariance @ spread))
    return RingMeasurement(measurement.time_s, measurement.sensor, tuple(candidates), ring)


def run(
    runs: Annotated[Path, "folder of the runs of fusion-approach, kept"], *,
    model: Annotated[Path | None, "view model of the client; for new runs"] = None,
    first_seed: int = 0, seeds: int = 8,
) -> None:  # fmt: skip
    """The ring's radius and depth as states of the filter, while approaches go on.

    In each approach what is told of the ring is wrong: its radius by σ = 3 %, its place along the
    axis by σ = 10 cm. The recognizer and the laser know nothing of the ring; the same ellipses are
    read with the wrong radius. Printed: errors of both states with their σ at ranges from the ring.
    """
    views = ViewModel.load(model) if model else None
    true_ring = ring_of_client()
    options = replace(OPTIONS, ring_radius_sigma=RADIUS_SIGMA, ring_depth_sigma_m=DEPTH_SIGMA_M)
    table = np.full((seeds, len(RANGES_M), 4), np.nan)
    wrong = np.empty((seeds, 2))
    for k in range(seeds):
        seed = first_seed + k
        make_run(runs / str(seed), seed, views, keep_frames=False)
        flown = load_run(runs / str(seed))
        rng = np.random.default_rng([8, seed])
        scale = 1.0 + RADIUS_SIGMA * rng.standard_normal()
        shift_m = DEPTH_SIGMA_M * rng.standard_normal()
        wrong[k] = scale - 1.0, -shift_m
        ring = replace(true_ring, centre_m=true_ring.centre_m + shift_m * true_ring.axis)
        fusion = Fusion(options)
        pending = [told(m, ring, scale) for m in flown.measurements]
        for time_s in sorted(flown.truth):
            while pending and pending[0].time_s <= time_s:
                fusion.add(pending.pop(0))
            range_m = float(flown.truth[time_s].apply(true_ring.centre_m)[2])
            now = fusion.state_at(time_s)
            if now.ring_radius is None or now.ring_depth_m is None or now.ring_covariance is None:
                continue
            # R told times the state is R; the ring's place told plus the state is its place.
            radius = now.ring_radius * scale - 1.0
            depth_m = now.ring_depth_m + shift_m
            sigma = np.sqrt(np.diag(now.ring_covariance))
            for j, least_m in enumerate(RANGES_M):
                if range_m >= least_m:
                    table[k, j] = radius, depth_m, sigma[0] * scale, sigma[1]
    print(f"{seeds} approaches, seeds {first_seed} to {first_seed + seeds - 1}; r.m.s. (σ)")
    start = np.sqrt(np.mean(wrong**2, axis=0))
    print(f"as told: radius {100.0 * start[0]:.2f} %, depth {1e3 * start[1]:.0f} mm")
    for j, range_m in enumerate(RANGES_M):
        error = np.sqrt(np.nanmean(table[:, j] ** 2, axis=0))
        square = np.nanmean((table[:, j, :2] / table[:, j, 2:]) ** 2, axis=0)
        print(
            f"{range_m:5.1f} m: radius {100.0 * error[0]:.3f} % ({100.0 * error[2]:.3f}), depth "
            f"{1e3 * error[1]:.1f} mm ({1e3 * error[3]:.1f}); squared error over variance "
            f"{square[0]:.2f}, {square[1]:.2f}"
        )
