"""One sensor dead, biased or late for a third of an approach: does the filter diverge?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from experiments.frame import show, table_of, two
from experiments.fusion.trials import Flight, Run, fly, load_run
from rendezview.fusion import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
)
from rendezview.geometry.pose import Pose

SENSORS = {
    "none": (),
    "appearance": ("appearance",),
    "ring": ("ring",),
    "laser": ("laser",),
    "camera": ("appearance", "ring"),
}
FAULTS = ("dead", "lying", "late")
THIRDS = ("first", "middle", "last")
LATE_S = 0.5
END_S = 5.0


def lying(measurement: Measurement) -> Measurement:
    """With a constant offset."""
    tilt = Rotation.from_rotvec([np.deg2rad(3.0), 0.0, 0.0]).as_matrix()
    if isinstance(measurement, PoseMeasurement):
        pose = measurement.pose
        moved = Pose(tilt @ pose.rotation, pose.translation_m + np.array([0.2, -0.15, 0.4]))
        return replace(measurement, pose=moved)
    if isinstance(measurement, RingMeasurement):
        off_m = np.array([0.1, -0.1, 0.2])
        each = measurement.candidates
        rings = tuple(RingCandidate(c.centre_m + off_m, tilt @ c.axis, c.covariance) for c in each)
        return replace(measurement, candidates=rings)
    assert isinstance(measurement, RangeMeasurement)
    return replace(measurement, range_m=measurement.range_m + 0.5)


def with_fault(run: Run, sensors: tuple[str, ...], fault: str, third: int) -> Run:
    """The run with a fault in a third of its time; the last frame is in the last third."""
    third_s, changed = max(run.truth) / 3.0, list[Measurement]()
    for measurement in run.measurements:
        here = min(int(measurement.time_s / third_s), 2) == third
        if measurement.sensor not in sensors or not here:
            changed.append(measurement)
        elif fault == "lying":
            changed.append(lying(measurement))
        elif fault == "late":
            changed.append(replace(measurement, time_s=measurement.time_s + LATE_S))
    changed.sort(key=lambda m: m.time_s)
    return Run(changed, run.truth)


def outcome(flight: Flight, third: int) -> tuple[float, int, bool]:
    """Worst error of the ring's centre over range while the fault lasts (NaN: no state); frames
    without a state, from the first state on; whether the flight has diverged."""
    end_s = flight.samples[-1].time_s
    start_s, stop_s = end_s * third / 3.0, end_s * (third + 1) / 3.0
    error = {s.time_s: s.fused[0] / s.range_m for s in flight.samples}
    during = [e for t, e in error.items() if start_s <= t < stop_s and np.isfinite(e)]
    begun = [s for s in flight.samples if np.isfinite(s.fused[0])]
    first_s = begun[0].time_s if begun else np.inf
    without = sum(np.isnan(s.fused[0]) for s in flight.samples if s.time_s >= first_s)
    last = [s for s in flight.samples if s.time_s >= end_s - END_S]
    bound = chdtri(6, 1e-4)
    bad = [s.nees > bound if np.isfinite(s.nees) else third < 2 for s in last]
    return max(during, default=np.nan), without, any(bad)


def run(runs: Path, *, seeds: int = 50) -> None:
    """One sensor dead, biased or late for a third of an approach: does the filter diverge?

    RUNS are those of fusion-approach. In the first, middle or last third of the time one sensor (or
    the camera: recognizer and ring at once) is silent (dead), adds a constant offset (lying), or
    stamps data of 0.5 s ago with the present time (late). The offset: pose 0.2 m, −0.15 m, 0.4 m
    and 3° about an axis across the line of sight; ring 0.1 m, −0.1 m, 0.2 m and 3°; range 0.5 m.

    A run has diverged if its state in the last 5 s is wrong beyond its own 99.99 % bound (six
    degrees of freedom), or if it has no state although the fault is over.
    """
    kept = [load_run(runs / str(seed)) for seed in range(seeds)]
    title = (
        f"{seeds} seeds; error of the ring's centre while it lasts in % of range, median / worst"
    )
    table = table_of(title, "sensor | fault | third | error | without a state | diverged", left=3)
    for name, sensors in SENSORS.items():
        for fault in FAULTS if sensors else ("–",):
            for third, word in enumerate(THIRDS if sensors else THIRDS[:1]):
                flights = [fly(with_fault(run, sensors, fault, third)) for run in kept]
                found = np.array([outcome(flight, third) for flight in flights]).T
                worst = found[0, np.isfinite(found[0])]
                error = two(100.0 * worst, 100) if len(worst) else "–"
                table.add_row(name, fault, word, error, *(f"{n.sum():.0f}" for n in found[1:]))
    show(table, width=100)
