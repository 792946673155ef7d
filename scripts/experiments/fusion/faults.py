"""Drawn readings of four sensors through the filter: every kind of motion, and every fault."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from experiments.frame import nees, show, table_of
from experiments.fusion.drawn_readings import FAULTS, RING, STEP_S, Draw, faulty, grid
from rendezview.fusion import Fusion, Measurement, PoseMeasurement
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.observation import Status

BINS_M = ((99.0, 26.0), (26.0, 8.0), (8.0, 0.0))
_PEER_DENSITY = 1e-2  # m/s² √s squared, of the peer: set by hand
_FEW = 4  # readings of a sensor in a bin, below which it is not compared


@dataclass(frozen=True)
class Sample:
    """Errors after the last reading of one time."""

    range_m: float
    fused: Array  # place (m), attitude (rad), NEES
    single: dict[str, Array]  # the same of each sensor with a pose
    peer: float  # place, m
    tracking: bool
    beyond: bool  # farther off than its protection level
    alarm: bool


@dataclass(frozen=True)
class Result:
    """One flight."""

    samples: list[Sample]
    restarts: int
    step_us: float


def fly(draw: Draw) -> Result:
    """All readings through the filter with its defaults; the last of one time counts."""
    fusion, peer, readings, spent = Fusion(), _Peer(), draw.readings(), 0.0
    samples: dict[float, Sample] = {}
    singles: dict[float, dict[str, Array]] = {}
    for k, reading in enumerate(readings):
        begun = time.perf_counter()
        fusion.add(reading)
        spent += time.perf_counter() - begun
        peer.add(reading)
        if isinstance(reading, PoseMeasurement):
            truth = draw.poses[round(reading.time_s / STEP_S)]
            errors = _errors(reading.pose, truth, reading.covariance)
            singles.setdefault(reading.time_s, {})[reading.sensor] = errors
        now_s = fusion.time_s
        more = k + 1 < len(readings) and readings[k + 1].time_s == reading.time_s
        if now_s is not None and not more:
            samples[now_s] = _sample(fusion, now_s, draw.poses[round(now_s / STEP_S)], peer)
    for time_s, sample in samples.items():
        sample.single.update(singles.get(time_s, {}))
    return Result(list(samples.values()), fusion.starts - 1, 1e6 * spent / len(readings))


def _sample(fusion: Fusion, time_s: float, truth: Pose, peer: _Peer) -> Sample:
    estimate = fusion.state_at(time_s)
    away = float(np.linalg.norm(truth.apply(RING.centre_m)))
    beside = peer.error_m(truth)
    if estimate.pose is None or estimate.covariance is None or estimate.protection is None:
        return Sample(away, np.full(3, np.nan), {}, beside, False, False, True)
    errors = _errors(estimate.pose, truth, estimate.covariance[:6, :6])
    levels = estimate.protection
    beyond = errors[0] > levels.position_m or errors[1] > levels.attitude_rad
    tracking = estimate.status is Status.TRACKING
    return Sample(away, errors, {}, beside, tracking, bool(beyond), levels.alarm)


def _errors(pose: Pose, truth: Pose, covariance: Array) -> Array:
    off = pose.delta_from(truth)
    return np.array([np.linalg.norm(off[3:]), np.linalg.norm(off[:3]), nees(off, covariance)])


class _Peer:
    """filterpy's Kalman filter of place and velocity, camera frame; silent where it is missing."""

    def __init__(self) -> None:
        self._time_s: float | None = None
        try:
            from filterpy.kalman import KalmanFilter
        except ModuleNotFoundError:
            self._filter = None
            return
        self._filter = KalmanFilter(dim_x=6, dim_z=3)
        self._filter.H = np.eye(3, 6)

    def add(self, reading: Measurement) -> None:
        """Take the place of a pose; of a late one, as if it were of now."""
        if self._filter is None or not isinstance(reading, PoseMeasurement):
            return
        place, covariance = reading.pose.translation_m, reading.covariance[3:, 3:]
        if self._time_s is None:
            self._filter.x = np.r_[place, np.zeros(3)]
            self._filter.P = np.diag([*covariance.diagonal(), 0.25, 0.25, 0.25])
        elif reading.time_s > self._time_s:
            dt = reading.time_s - self._time_s
            self._filter.F = np.eye(6) + dt * np.eye(6, k=3)
            noise = _PEER_DENSITY**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            self._filter.predict(Q=np.kron(noise, np.eye(3)))
        self._filter.update(place, R=covariance)
        self._time_s = max(reading.time_s, self._time_s or reading.time_s)

    def error_m(self, truth: Pose) -> float:
        """Of the place."""
        if self._filter is None:
            return np.nan
        return float(np.linalg.norm(np.ravel(self._filter.x)[:3] - truth.translation_m))


def _rms(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def ratios(samples: list[Sample], far: float, near: float) -> Array:
    """(4,) place and attitude over the best sensor's, NEES, place over peer."""
    chosen = [s for s in samples if near <= s.range_m < far]
    names = {name for s in chosen for name in s.single}
    single = {
        name: found
        for name in names
        if len(found := np.array([s.single[name] for s in chosen if name in s.single])) >= _FEW
    }
    if not single:
        return np.full(4, np.nan)
    fused = np.array([s.fused for s in chosen])
    best = [min(single.values(), key=lambda e: _rms(e[:, k])) for k in (0, 1)]
    return np.array(
        [
            _rms(fused[:, 0]) / _rms(best[0][:, 0]),
            _rms(fused[:, 1]) / _rms(best[1][:, 1]),
            np.nanmean(fused[:, 2]),
            _rms(fused[:, 0]) / _rms(np.array([s.peer for s in chosen])),
        ]
    )


def run(
    *,
    runs: Annotated[int, "flights of the grid"] = 48,
    fault_runs: Annotated[int, "flights of each fault"] = 5,
    seed: int = 0,
) -> None:
    """Drawn readings of a camera, stereo, a ring sensor and a laser through the filter.

    First a grid: braking 0–20 mm/s², spin to 3 °/s, pointing jitter to 0.5° at 0.15–30 Hz, errors
    white or lasting. Then one fault at a time. The filter has its defaults. Place and attitude are
    r.m.s. of a flight over the best single sensor's in the same bin of range; NEES of six is right
    at 6. The peer is filterpy's Kalman filter of the place, tuned by hand (1e-2 m/s² √s); it has
    no flight with jitter here.
    """
    flown = [(flight, fly(Draw(flight, seed + k))) for k, flight in enumerate(grid(runs, seed))]
    table = table_of(
        f"{runs} flights, mean (largest)",
        "m | place | attitude | NEES | runs in 3–11 % | place over filterpy",
    )
    for far, near in BINS_M:
        found = np.array([ratios(result.samples, far, near) for _, result in flown])
        still = np.array([flight.jitter_deg == 0.0 for flight, _ in flown])
        inside = np.mean((found[:, 2] > 3.0) & (found[:, 2] < 11.0))
        table.add_row(
            f"{far:g}–{near:g}", *(_mean(found[:, k], "{:.2f} ({:.2f})") for k in (0, 1)),
            _mean(found[:, 2], "{:.1f} ({:.1f})"), f"{100 * inside:.0f}",
            _mean(found[still, 3], "{:.2f} ({:.2f})"),
        )  # fmt: skip
    show(table)
    every = [s for _, result in flown for s in result.samples]
    after_start = [s for _, result in flown for s in result.samples[3:]]
    print(
        f"restarts {sum(result.restarts for _, result in flown)}; tracking after the third "
        f"{100 * np.mean([s.tracking for s in after_start]):.2f} %; beyond the protection level "
        f"{100 * np.mean([s.beyond for s in every]):.3f} %, unalarmed "
        f"{100 * np.mean([s.beyond and not s.alarm for s in every]):.3f} %; alarms "
        f"{100 * np.mean([s.alarm for s in every]):.2f} %; a reading "
        f"{np.median([result.step_us for _, result in flown]):.0f} µs"
    )
    faults_table(fault_runs, seed)


def faults_table(runs: int, seed: int) -> None:
    """Each fault: error, how long the state is beyond its level, restarts."""
    table = table_of(
        f"faults, {runs} flights each",
        "fault | place over best sensor, m: 99–26 | 26–8 | 8–0 | beyond level, unalarmed % | "
        "longest, readings | restarts",
    )
    for fault in FAULTS:
        results = [fly(Draw(faulty(fault), 1000 + seed + k)) for k in range(runs)]
        cells = [
            _mean(np.array([ratios(r.samples, far, near)[0] for r in results]), "{:.2f} ({:.2f})")
            for far, near in BINS_M
        ]
        silent = [[s.beyond and not s.alarm for s in r.samples] for r in results]
        longest = max(_longest(row) for row in silent)
        share = 100 * np.mean([one for row in silent for one in row])
        restarts = sum(r.restarts for r in results)
        table.add_row(fault, *cells, f"{share:.2f}", str(longest), str(restarts))
    show(table)


def _longest(row: list[bool]) -> int:
    """Longest stretch of true ones."""
    longest = here = 0
    for one in row:
        here = here + 1 if one else 0
        longest = max(longest, here)
    return longest


def _mean(values: Array, form: str) -> str:
    values = values[np.isfinite(values)]
    return form.format(values.mean(), values.max()) if len(values) else "–"
