"""Modelled sensors: readings drawn from error tables that were measured on rendered frames."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.optimize import approx_fprime

from rendezview.estimation.motion import extrapolate
from rendezview.fusion import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RateMeasurement,
    RingCandidate,
    RingMeasurement,
    ThrustMeasurement,
)
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.io.target import DockingRing
from rendezview.sensors.beacons import predict_spots
from rendezview.sensors.beam import Met
from rendezview_ground.fly.dynamics import Truth
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.guidance import Known
from rendezview_ground.fly.setup import CAMERA, Setup
from rendezview_ground.mesh.directions import axes_towards

_STREAM = 3  # of the seed
# Of the frames whose claims are lower than the table's. Source: by construction, to 2 %
SHARES = (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98)
_LEAST_THRUST_M_S = 1e-4  # σ of a pulse that is told. Source: a quarter of the least impulse


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """How often a sensor answers, its σ (K,) and the σ that it claims (K,)."""

    answered: float
    sigma: Array
    claimed: Array
    scatter: Array  # of the logarithm of what it claims, from frame to frame: at `SHARES`
    follows: float  # the power of a frame's claim that its errors grow with
    lasting: float  # share of their variance that lasts
    wild: float  # share of the readings that are of something else
    wild_sigma: Array  # (K,) of these

    def in_frame(self, rng: np.random.Generator) -> Quality:
        """As good or as bad as one frame is."""
        times = math.exp(np.interp(rng.random(), SHARES, self.scatter))
        worse = times**self.follows
        sigma = self.wild_sigma if rng.random() < self.wild else worse * self.sigma
        return replace(self, sigma=sigma, claimed=times * self.claimed)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorTable:
    """The quality of a sensor by range."""

    range_m: Array  # (N,) rising
    answered: Array  # (N,)
    sigma: Array  # (N, K)
    claimed: Array  # (N, K)
    scatter: Array  # (N, S)
    follows: Array  # (N,)
    lasting: Array  # (N,)
    wild: Array  # (N,)
    wild_sigma: Array  # (N, K)

    def at(self, range_m: float) -> Quality:
        """Interpolated in the logarithms."""
        x, known = math.log(max(range_m, 1e-3)), np.log(self.range_m)
        columns = [
            np.array([math.exp(np.interp(x, known, np.log(column))) for column in table.T])
            for table in (self.sigma, self.claimed, self.wild_sigma)
        ]
        answered, follows, lasting, wild = (
            float(np.interp(x, known, some))
            for some in (self.answered, self.follows, self.lasting, self.wild)
        )
        scatter = np.array([np.interp(x, known, share) for share in self.scatter.T])
        sigma, claimed, wild_sigma = columns
        return Quality(answered, sigma, claimed, scatter, follows, lasting, wild, wild_sigma)


@lru_cache(maxsize=1)
def measured() -> tuple[dict[str, ErrorTable], list[dict[str, Any]]]:
    """The tables of the sensors that look at frames, and what glare leaves of each."""
    data = json.loads(files("rendezview_ground.fly").joinpath("measured.json").read_text("utf-8"))
    rows = sorted(data["rows"], key=lambda row: float(row["range_m"]))
    ranges = np.array([row["range_m"] for row in rows])
    tables = {
        name: ErrorTable(
            ranges, *(np.array([row[name][column.name] for row in rows])
                      for column in fields(ErrorTable)[1:]),
        )
        for name in ("camera", "ring", "reflectors")
    }  # fmt: skip
    return tables, data["glare"]


def in_glare(sensor: str, quality: Quality, peak_grey: float) -> Quality:
    """What stray light leaves of a sensor."""
    rows = measured()[1]
    peaks = [math.log(row["peak_grey"]) for row in rows]
    answered, error, claimed = (
        float(np.interp(math.log(peak_grey), peaks, [row[sensor][key] for row in rows]))
        for key in ("answered", "error", "claimed")
    )
    return replace(
        quality, answered=answered * quality.answered, sigma=error * claimed * quality.sigma,
        claimed=claimed * quality.claimed,
    )  # fmt: skip


class OwnSensors:
    """Gyroscope, thrusters' telemetry and laser ranger: the same with frames and without."""

    def __init__(self, setup: Setup, seed: int, fault: Fault | None = None) -> None:
        self.plan, self.mesh, self.fault = setup.plan, setup.beam, fault
        self._rng = np.random.default_rng([_STREAM, seed])
        bias = math.radians(self.plan.chaser.gyro_bias_deg_s)
        self._gyro_bias = bias * self._rng.standard_normal(3)

    def due(self, time_s: float, every_s: float) -> bool:
        """Whether a sensor that reads so often reads in this step."""
        step = self.plan.guidance.step_s
        return round(time_s / step) % max(round(every_s / step), 1) == 0

    def struck(self, kind: str, time_s: float) -> bool:
        """Whether a fault is there."""
        return self.fault is not None and self.fault.strikes(kind, time_s)

    def read(self, truth: Truth) -> list[Measurement]:
        """All readings of a step."""
        chaser, step_s = self.plan.chaser, self.plan.guidance.step_s
        noise, bias = math.radians(chaser.gyro_deg_s), math.radians(chaser.gyro_bias_deg_s)
        rate = truth.turning + self._gyro_bias + noise * self._rng.standard_normal(3)
        found: list[Measurement] = []
        told = truth.told_m_s
        if told.any():
            sigma = math.hypot(chaser.thrust_scale, chaser.thrust_scale_each,
                               math.radians(chaser.thrust_askew_deg))  # fmt: skip
            spread = sigma * float(np.linalg.norm(told)) + _LEAST_THRUST_M_S
            # The push lasts for the step: as a jump it belongs to its middle.
            found.append(ThrustMeasurement(truth.time_s - 0.5 * step_s, "thrust", told, spread))
        found.append(RateMeasurement(truth.time_s, "gyro", rate, math.hypot(noise, bias)))
        if self.due(truth.time_s, self.plan.sensors.laser_s):
            found += self._laser(truth)
        return found

    def _laser(self, truth: Truth) -> list[Measurement]:
        sensors, target = self.plan.sensors, truth.pose.inverse()
        origin, beam = np.array(sensors.laser_origin_m), np.array([0.0, 0.0, 1.0])
        met = self.mesh.met(target.apply(origin), target.rotation @ beam, np.zeros((3, 3)))
        noise = sensors.laser_m * float(self._rng.standard_normal())
        if not isinstance(met, Met):
            return []
        range_m = met.distance_m + noise
        if self.struck("laser", truth.time_s):
            assert self.fault is not None
            range_m += self.fault.size
        if range_m <= 0.0:
            return []
        return [
            RangeMeasurement(truth.time_s, "laser", range_m, sensors.laser_m, self.mesh, origin)
        ]


class ModelledSensors:
    """All sensors of a flight without pictures, by the measured error tables."""

    def __init__(self, setup: Setup, seed: int, fault: Fault | None = None) -> None:
        """For one flight."""
        self.plan, self.ring, self.centre_m = setup.plan, setup.port.ring, setup.port.centre_m
        self.patterns, self.fault, self.pair = setup.patterns, fault, setup.stereo_pair()
        self._own = OwnSensors(setup, seed, fault)
        self._rng = np.random.default_rng([_STREAM + 1, seed])
        self._lasting: dict[str, tuple[float, Array]] = {}

    def read(self, truth: Truth, _: Known | None) -> list[Measurement]:
        """All readings of a step."""
        found = self._own.read(truth)
        own, time_s = self._own, truth.time_s
        if not own.due(time_s, self.plan.sensors.frame_s) or own.struck("camera", time_s):
            return found
        centre = truth.pose.apply(self.centre_m)
        found += self._camera(truth, centre)
        if self.ring is not None:
            found += self._ring(truth, centre, self.ring)
        if not own.struck("reflectors", time_s):
            found += self._reflectors(truth, centre)
        if self.pair is not None and centre[2] <= self.plan.sensors.stereo_m:
            spots = self.pair.modelled(truth.pose, self.plan.sensors.led_px, self._rng)
            seen = self.pair.read(time_s, spots).measurement("stereo")
            found += [] if seen is None else [seen]
        return found

    def _error(self, sensor: str, size: int, time_s: float, share: float) -> Array:
        """(size,) in σ: a part that lasts, its share of the variance, and white noise."""
        lasting_s = self.plan.sensors.lasting_s
        white, fresh = self._rng.standard_normal((2, size))
        if sensor in self._lasting:
            last_s, last = self._lasting[sensor]
            kept = math.exp(-(time_s - last_s) / lasting_s)
            fresh = kept * last + math.sqrt(1.0 - kept**2) * fresh
        self._lasting[sensor] = time_s, fresh
        error: Array = math.sqrt(share) * fresh + math.sqrt(1.0 - share) * white
        return error

    def _quality(self, sensor: str, truth: Truth, away_m: float) -> Quality:
        """Of a sensor in a frame; in glare, of what it leaves."""
        quality = measured()[0][sensor].at(away_m)
        if self._own.struck("glare", truth.time_s):
            assert self.fault is not None
            quality = in_glare(sensor, quality, self.fault.size)
        return quality.in_frame(self._rng)

    def _camera(self, truth: Truth, centre: Array) -> list[Measurement]:
        away, rng = float(np.linalg.norm(centre)), self._rng
        quality = self._quality("camera", truth, away)
        error = _six(quality.sigma, away) * self._error("camera", 6, truth.time_s, quality.lasting)
        if rng.random() >= quality.answered:
            return []
        arm = truth.pose.rotation @ self.centre_m
        pose, into = extrapolate(truth.pose, error, 1.0, self.centre_m), np.eye(6)
        into[3:, :3] = so3.hat(arm)  # t = centre − R arm: turning the arm moves the origin
        covariance = into @ np.diag(_six(quality.claimed, away) ** 2) @ into.T
        return [PoseMeasurement(truth.time_s, "camera", pose, covariance)]

    def _ring(self, truth: Truth, centre: Array, ring: DockingRing) -> list[Measurement]:
        """Both circles of the ellipse; an edge of another radius looks nearer or farther."""
        away, rng = float(np.linalg.norm(centre)), self._rng
        quality = self._quality("ring", truth, away)
        sigma, claimed = quality.sigma, quality.claimed
        error = self._error("ring", 5, truth.time_s, quality.lasting)
        if rng.random() >= quality.answered:
            return []
        sight = centre / away
        place = centre + _across_and_along(sight, away * sigma[1:]) @ error[:3]
        if self._own.struck("ring", truth.time_s):
            assert self.fault is not None
            place = place * self.fault.size
        axis = truth.pose.rotation @ ring.axis
        tilt = _across_and_along(axis, np.array([sigma[0], 0.0])) @ [*error[3:], 0.0]
        moves = tilt_moves(centre, ring.radius_m)
        place, axis = place + moves @ tilt, axis + tilt
        axis /= np.linalg.norm(axis)
        root = _across_and_along(sight, away * claimed[1:])
        other = 2.0 * (axis @ sight) * sight - axis
        both = []
        for normal, middle in ((axis, place), (other, place + moves @ (other - axis))):
            flat = claimed[0] ** 2 * (np.eye(3) - np.outer(normal, normal))
            covariance = np.zeros((6, 6))
            covariance[:3, :3] = root @ root.T + moves @ flat @ moves.T
            covariance[:3, 3:] = moves @ flat
            covariance[3:, :3], covariance[3:, 3:] = covariance[:3, 3:].T, flat
            both.append(RingCandidate(middle, normal, covariance))
        return [RingMeasurement(truth.time_s, "ring", tuple(both), ring)]

    def _reflectors(self, truth: Truth, centre: Array) -> list[Measurement]:
        """A pose by the first group that is whole in the picture; σ of the Cramér–Rao bound."""
        sensors, away = self.plan.sensors, float(np.linalg.norm(centre))
        quality = self._quality("reflectors", truth, away)
        if away > sensors.reflectors_m or self._rng.random() >= quality.answered:
            return []
        for pattern in self.patterns:
            spots = predict_spots(CAMERA, pattern, truth.pose)
            inside = np.isfinite(spots).all() and (spots > 0.0).all()
            if not (inside and (spots < [CAMERA.width - 1, CAMERA.height - 1]).all()):
                continue
            # 1e-4: rad and m of the difference
            slope = approx_fprime(
                np.zeros(6),
                lambda e, p=pattern: predict_spots(CAMERA, p, truth.pose.perturbed(e)).ravel(),
                1e-4,
            )
            sigma = sensors.reflector_bound * sensors.reflector_px
            covariance = sigma**2 * np.linalg.inv(slope.T @ slope)
            root = np.linalg.cholesky(covariance)
            times = float((quality.sigma / quality.claimed).mean())
            name = f"reflectors {pattern.name}"
            error = times * root @ self._error(name, 6, truth.time_s, quality.lasting)
            pose = truth.pose.perturbed(error)
            return [PoseMeasurement(truth.time_s, "reflectors", pose, covariance)]
        return []


def _six(sigma: Array, away_m: float) -> Array:
    """(6,) of tilt twice, roll, across twice, along, from a row of the table."""
    tilt, roll, across, along = sigma
    return np.array([tilt, tilt, roll, away_m * across, away_m * across, away_m * along])


def tilt_moves(centre: Array, radius_m: float) -> Array:
    """(3, 3) how far a tilt of a ring's axis moves its centre, m: across the line of sight.

    The middle of an ellipse is seen well, and lies r² n_x n_z / d² beside the picture of the centre
    of a circle of radius r with normal n at a distance d.
    """
    away = float(np.linalg.norm(centre))
    sight = centre / away
    moves: Array = radius_m**2 / away * (np.eye(3) - np.outer(sight, sight))
    return moves


def _across_and_along(direction: Array, sigma: Array) -> Array:
    """(3, 3) root of a covariance: two axes across a direction, and one along it."""
    return np.asarray(axes_towards(direction).T * sigma[[0, 0, 1]])
