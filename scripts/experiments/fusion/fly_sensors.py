"""Errors of the sensors on rendered flights: the tables that modelled flights draw from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from experiments.frame import CLIENT
from rendezview.fusion import Measurement, PoseMeasurement, RingMeasurement
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.fly.dynamics import OrbitDynamics, Truth
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.guidance import Guidance, Known
from rendezview_ground.fly.loop import FusedEstimator, Loop
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.rendered import RenderedSensors
from rendezview_ground.fly.sensors import SHARES, ModelledSensors, tilt_moves
from rendezview_ground.fly.setup import Setup
from rendezview_ground.mesh.mesh import load_mesh

EDGES_M = (61.0, 45.0, 32.0, 22.0, 16.0, 11.0, 7.5, 5.0, 3.0, 2.0, 1.5, 1.2, 1.0)
SENSORS = ("camera", "ring", "reflectors")
OUTLIER = 5.0  # claimed σ beyond which a reading is wild: another edge, a wrong roll
PEAKS_GREY = (100.0, 200.0, 400.0, 800.0, 1600.0)  # of stray light
GLARE_S = 30.0  # of every other half minute
GLARE_FLIGHTS = 2  # of each peak
FEWEST = 4  # readings of a row


class _Flickering(Fault):
    """A fault that comes and goes."""

    def strikes(self, kind: str, time_s: float) -> bool:
        return self.kind == kind and time_s // GLARE_S % 2 == 1


@dataclass
class Seen:
    """One frame: the range, and of each sensor that answered (2, k) errors and claimed σ."""

    seed: int
    time_s: float
    range_m: float
    bad: bool  # in glare
    found: dict[str, Array] = field(default_factory=dict)


class _Beside:
    """Flies by the modelled sensors, and has the real ones look at the same frames."""

    def __init__(self, setup: Setup, seed: int, fault: Fault | None, seen: list[Seen]) -> None:
        self.centre_m, self.axis = setup.port.centre_m, setup.port.axis
        self.flown, self.real = ModelledSensors(setup, seed), RenderedSensors(setup, seed, fault)
        self.seed, self.fault, self.seen = seed, fault, seen

    def read(self, truth: Truth, known: Known | None) -> Sequence[Measurement]:
        told = self.real.read(truth, known)
        if self.real.own.due(truth.time_s, self.real.plan.sensors.frame_s):
            away = float(np.linalg.norm(truth.pose.apply(self.centre_m)))
            bad = self.fault is not None and self.fault.strikes("glare", truth.time_s)
            one = Seen(self.seed, truth.time_s, away, bad)
            for reading in told:
                if isinstance(reading, PoseMeasurement):
                    one.found[reading.sensor] = self._pose(reading, truth)
                elif isinstance(reading, RingMeasurement):
                    one.found["ring"] = self._ring(reading, truth)
            self.seen.append(one)
        return self.flown.read(truth, known)

    def _pose(self, reading: PoseMeasurement, truth: Truth) -> Array:
        """Tilt twice, roll; the port's centre across twice and along."""
        pose = reading.pose
        turn = so3.log(np.ascontiguousarray(pose.rotation @ truth.pose.rotation.T))
        off = pose.apply(self.centre_m) - truth.pose.apply(self.centre_m)
        into = np.eye(6)
        into[3:, :3] = -so3.hat(pose.rotation @ self.centre_m)
        covariance = into @ reading.covariance @ into.T
        return np.array([np.r_[turn, off], np.sqrt(covariance.diagonal())])

    def _ring(self, reading: RingMeasurement, truth: Truth) -> Array:
        """Tilt twice; the centre across twice and along. Of the better of two circles.

        Across without what the tilt moves it by, see `tilt_moves`.
        """
        axis, centre = truth.pose.rotation @ self.axis, truth.pose.apply(self.centre_m)
        one = max(reading.candidates, key=lambda c: abs(float(c.axis @ axis)))
        off = np.append(one.centre_m - centre, one.axis * np.sign(one.axis @ axis) - axis)
        apart = np.eye(6)
        apart[:3, 3:] = -tilt_moves(centre, reading.ring.radius_m)
        own, covariance = apart @ off, apart @ one.covariance @ apart.T
        sigma = np.sqrt(covariance.diagonal())
        tilt = np.sqrt(np.trace(covariance[3:, 3:]) / 2.0)
        turn = np.cross(axis, off[3:])
        return np.array([np.r_[turn[:2], own[:3]], np.r_[tilt, tilt, sigma[:3]]])


def flown(setup: Setup, seed: int, peak_grey: float) -> list[Seen]:
    """All frames of a flight; with a peak, in stray light for every other half minute."""
    seen: list[Seen] = []
    fault = _Flickering("glare", 0.0, 1e9, peak_grey) if peak_grey else None
    sensors = _Beside(setup, seed, fault, seen)
    dynamics = OrbitDynamics(setup.plan, setup.port, seed)
    Loop(sensors, FusedEstimator(), Guidance(setup.plan, setup.port), dynamics).run()
    return seen


def _groups(sensor: str) -> list[slice]:
    """Columns of tilt, roll, across and along."""
    pose = [slice(0, 2), slice(2, 3), slice(3, 5), slice(5, 6)]
    return [slice(0, 2), slice(2, 4), slice(4, 5)] if sensor == "ring" else pose


def _row(sensor: str, seen: list[Seen]) -> dict[str, Any]:
    """Share of frames answered, σ and claimed σ, scatter of the claims (its logarithm at `SHARES`).

    ``follows`` is the power of a frame's claim that its errors grow with, ``lasting`` the share of
    them that lasts. Wild readings are apart: their share of the answers, and the σ of their errors.
    """
    found = [(s.range_m, s.found[sensor]) for s in seen if sensor in s.found]
    row: dict[str, Any] = {"answered": round(len(found) / max(len(seen), 1), 3)}
    wild = [f for f in found if np.abs(f[1][0] / f[1][1]).max() > OUTLIER]
    found = [f for f in found if np.abs(f[1][0] / f[1][1]).max() <= OUTLIER]
    if len(found) < FEWEST:
        return row
    errors, claims = np.array([f[1] for f in found]).transpose(1, 0, 2)
    larger = np.log(claims[:, 0]) - np.log(claims[:, 0]).mean()
    sizes = np.log(np.abs(errors / np.exp(np.log(claims).mean(axis=0)))).mean(axis=1)
    slope = float(larger @ (sizes - sizes.mean())) / max(float(larger @ larger), 1e-12)
    follows = min(max(slope, 0.0), 1.0)
    sigma, claimed = _sizes(sensor, found, np.exp(follows * larger))
    scatter = np.quantile(larger, SHARES).round(3).tolist()
    row |= {"sigma": sigma, "claimed": claimed, "scatter": scatter}
    row["follows"] = round(follows, 3)
    row["wild"] = round(len(wild) / (len(found) + len(wild)), 3)
    row["wild_sigma"] = sigma if not wild else _sizes(sensor, wild, np.ones(len(wild)))[0]
    return row


def _sizes(
    sensor: str, found: list[tuple[float, Array]], times: Array
) -> tuple[list[float], list[float]]:
    """σ and claimed σ by group; ``times`` (N,): how much worse a frame is than the usual one."""
    errors, claims = np.array([f[1] for f in found]).transpose(1, 0, 2)
    ranges = np.array([f[0] for f in found])
    sigma, claimed, groups = [], [], _groups(sensor)
    for place, columns in enumerate(groups):
        over = ranges[:, None] if place >= len(groups) - 2 else 1.0
        some, told = errors[:, columns] / over, claims[:, columns] / over
        claimed.append(float(f"{np.exp(np.log(told).mean()):.3g}"))
        sigma.append(float(f"{np.sqrt(((some / times[:, None]) ** 2).mean()):.3g}"))
    return sigma, claimed


def _filled(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows in which a sensor answered too seldom get the errors of the nearest that has them."""
    for sensor in SENSORS:
        known = [k for k, row in enumerate(rows) if "sigma" in row[sensor]]
        for k, row in enumerate(rows):
            nearest = rows[min(known, key=lambda other, k=k: abs(other - k))]
            row[sensor] = nearest[sensor] | row[sensor]
    return rows


def _lasting(sensor: str, seen: list[Seen], far: float, near: float) -> float:
    """Share of a sensor's errors, in claimed σ, that lasts: correlation with 1 and 2 frames before.

    Of frames between two ranges; 0 if there are too few.
    """
    one, two = [], []
    for lag in (1, 2):
        for a, b in zip(seen, seen[lag:], strict=False):
            both = a.seed == b.seed and sensor in a.found and sensor in b.found
            if both and near <= b.range_m < far:
                one.append(a.found[sensor][0] / a.found[sensor][1])
                two.append(b.found[sensor][0] / b.found[sensor][1])
    if len(one) < 2 * FEWEST:
        return 0.0
    x, y = np.clip(one, -OUTLIER, OUTLIER), np.clip(two, -OUTLIER, OUTLIER)
    correlation = float((x * y).mean() / np.sqrt((x**2).mean() * (y**2).mean()))
    return round(min(max(correlation, 0.0), 1.0), 3)


def _glare(bad: list[Seen], good: list[Seen], peak_grey: float) -> dict[str, Any]:
    """What stray light leaves of each sensor: answers, errors and claims over those without."""
    row: dict[str, Any] = {"peak_grey": peak_grey}
    for sensor in SENSORS:
        answers, expected, sizes, claims = 0, 0.0, [], []
        for far, near in pairwise(EDGES_M):
            plain, dazzled = (
                [s for s in some if near <= s.range_m < far and s.bad == (some is bad)]
                for some in (good, bad)
            )
            usual = [s.found[sensor] for s in plain if sensor in s.found]
            left = [s.found[sensor] for s in dazzled if sensor in s.found]
            if len(usual) < FEWEST:
                continue
            answers += len(left)
            expected += len(dazzled) * len(usual) / len(plain)
            claim = np.mean([np.log(f[1][0]) for f in usual])
            claims += [np.log(f[1][0]) - claim for f in left]
            sizes += [(_size(f), np.mean([_size(f) for f in usual])) for f in left]
        error = float(np.sqrt(np.divide(*np.sum(sizes, axis=0)))) if answers else 1.0
        row[sensor] = {
            "answered": round(min(answers / max(expected, 1.0), 1.0), 3),
            "error": round(error, 3),  # in claimed σ
            "claimed": round(float(np.exp(np.mean(claims))), 3) if answers else 1.0,
        }
    return row


def _size(found: Array) -> float:
    """Mean square of errors in claimed σ, of wild ones at most `OUTLIER`."""
    return float((np.minimum(np.abs(found[0] / found[1]), OUTLIER) ** 2).mean())


def measure(views: ViewModel, output: Path, seeds: int, seed: int, jobs: int) -> None:
    """Write the tables of ``training/rendezview_ground/fly/measured.json``.

    The chaser flies by modelled sensors; the real ones look at its frames.
    """
    target = Target.load(CLIENT)
    mesh = load_mesh(target.mesh_path, target.unit)
    setup = Setup.of(target, mesh, FlyPlan(), views)
    flights = [(seed + k, 0.0) for k in range(seeds)]
    for peak in PEAKS_GREY:
        first = flights[-1][0] + 1
        flights += [(first + k, peak) for k in range(GLARE_FLIGHTS)]
    made = Parallel(jobs)(delayed(flown)(setup, one, peak) for one, peak in flights)
    seen = [s for (_, peak), some in zip(flights, made, strict=True) if not peak for s in some]
    rows: list[dict[str, Any]] = []
    for far, near in pairwise(EDGES_M):
        some = [s for s in seen if near <= s.range_m < far]
        middle_m = round(float(np.sqrt(far * near)), 3)
        row: dict[str, Any] = {"range_m": middle_m, "frames": len(some)}
        for name in SENSORS:
            row[name] = _row(name, some)
            if "sigma" in row[name]:
                row[name]["lasting"] = _lasting(name, seen, far, near)
        rows.append(row)
        print(json.dumps(rows[-1]), flush=True)
    glare = []
    for peak in PEAKS_GREY:
        bad = [s for (_, p), some in zip(flights, made, strict=True) if p == peak for s in some]
        glare.append(_glare(bad, seen, peak))
        print(json.dumps(glare[-1]), flush=True)
    source = f"python -m experiments fusion-approach RUNS client.rvm --flights {seeds}"
    table = {"source": source, "rows": _filled(rows), "glare": glare}
    output.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
