"""Approaches drawn from a seed, without pictures: a true motion, and readings of four sensors.

The chaser starts 62 m before a ring. It coasts, or brakes with thrusters that are on or off so that
it never flies faster than its range allows. The target turns steadily, the camera swings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.fusion import (
    BeamSurface,
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RateMeasurement,
    RingCandidate,
    RingMeasurement,
)
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing

RING = DockingRing(np.array([-1.68, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), 0.6)
STEP_S = 0.1  # of the truth
_NEAREST_M = 1.0
_ERROR_S = 30.0  # correlation of a sensor's lasting errors


@dataclass(frozen=True, kw_only=True)
class Flight:
    """How the craft move, and what the errors are like."""

    braking_mm_s2: float | None = None  # None: smoothly slower; 0: steadily on
    spin_deg_s: float = 0.05
    jitter_deg: float = 0.0
    jitter_hz: float = 1.0
    lasting: float = 0.0  # share of the sensors' variance that is correlated over 30 s
    thrust_m_s: float = 0.0  # σ of a jump of the velocity, every 30 s
    fault: str = ""  # one of FAULTS
    gyroscope: bool = False  # 10 Hz, σ 0.01 °/s


FAULTS = {
    "outliers": "one reading in twenty is wrong",
    "offset": "the camera is 10 σ off for a minute",
    "stereo offset": "stereo is 0.36 m off for a minute",
    "wrong ring": "below 4 m the ring is one of 1.08 times the radius",
    "dead camera": "no pose of the camera for 40 s",
    "thrust": "the velocity jumps by 8 cm/s (σ) every 30 s",
    "late": "readings come up to 3 s late, out of order",
    "late stamps": "the camera's stamps are 1 s late",
}


def motion(flight: Flight, rng: np.random.Generator) -> tuple[Array, list[Pose], Array]:
    """Times (N,), true camera_from_target, and the camera's swings (N, 3, 3)."""
    count = round(280.0 / STEP_S)
    times: Array = STEP_S * np.arange(count, dtype=np.float64)
    ranges: Array = np.empty(count)
    if flight.braking_mm_s2 is None:
        ranges[:] = 60.0 * (1.0 - times / 281.0) ** 1.3 + 2.0
    elif flight.braking_mm_s2 == 0.0:
        ranges[:] = 62.0 - 0.25 * times
    else:
        range_m, speed, burning = 62.0, 0.4, False
        for k in range(count):
            ranges[k] = range_m
            allowed = range_m / 70.0
            burning = speed > (0.85 if burning else 1.05) * allowed
            range_m -= STEP_S * speed
            speed = max(0.01, speed - STEP_S * 1e-3 * flight.braking_mm_s2 * burning)
    phases = rng.uniform(0.0, 2 * np.pi, 2)
    across = np.column_stack([np.sin(0.029 * times + phases[0]), np.sin(0.025 * times + phases[1])])
    centres = np.column_stack([across * [0.4, 0.3] * (0.05 * ranges[:, None] + 0.1), ranges])
    if flight.thrust_m_s > 0.0:
        jumps = np.zeros((count, 3))
        burns = np.arange(300, count, 300)
        jumps[burns] = flight.thrust_m_s * rng.standard_normal((len(burns), 3)) * [1.0, 1.0, 0.5]
        pushed = STEP_S * np.cumsum(np.cumsum(jumps, axis=0), axis=0)
        centres += pushed * np.minimum(1.0, 0.1 * np.maximum(ranges, 1.0))[:, None] * 0.3
    spin = rng.standard_normal(3)
    spin *= math.radians(flight.spin_deg_s) / np.linalg.norm(spin)
    if flight.spin_deg_s < 1.0:
        spin = np.array([0.0, 0.0, np.linalg.norm(spin)])
    start = Rotation.from_rotvec(np.radians(6.0) * rng.standard_normal(3)) * _FACING
    turned = Rotation.from_rotvec(times[:, None] * spin) * start
    swing = Rotation.from_rotvec(_swing(flight, times, rng))
    rotations, swings = turned.as_matrix(), swing.as_matrix()
    places = centres - rotations @ RING.centre_m
    rotations, places = (swing * turned).as_matrix(), swing.apply(places)
    seen = np.linalg.norm(centres, axis=1) > _NEAREST_M
    last = count if seen.all() else int(np.argmin(seen))
    poses = [Pose(r, p) for r, p in zip(rotations[:last], places[:last], strict=True)]
    return times[:last], poses, swings[:last]


_FACING = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def _swing(flight: Flight, times: Array, rng: np.random.Generator) -> Array:
    """(N, 3) rotation vectors of the camera: five waves about each axis."""
    rates = flight.jitter_hz * rng.uniform(0.5, 1.5, (3, 5))
    phases = rng.uniform(0.0, 2 * np.pi, (3, 5))
    waves: Array = np.sin(2 * np.pi * rates * times[:, None, None] + phases).sum(axis=2)
    return math.radians(flight.jitter_deg) * math.sqrt(2.0 / 5.0) * waves


class Draw:
    """The sensors' readings of one flight."""

    def __init__(self, flight: Flight, seed: int) -> None:
        self.flight, self._rng = flight, np.random.default_rng([23, seed])
        self.times, self.poses, self._swings = motion(flight, self._rng)
        self._errors: dict[str, Array] = {}
        self._last_s: dict[str, float] = {}

    def readings(self) -> list[Measurement]:
        """In the order of arrival."""
        found = [m for k in range(0, len(self.times), 5) for m in self._at(k)]
        if self.flight.fault != "late":
            return found
        most_s = {"camera": 3.0, "stereo": 1.0, "ring": 2.0, "laser": 0.0, "gyro": 0.0}
        arrive = [m.time_s + self._rng.uniform(0.0, most_s[m.sensor]) for m in found]
        return [found[k] for k in np.argsort(arrive, kind="stable")]

    def _error(self, sensor: str, size: int, time_s: float) -> Array:
        """(size,) in σ: a part that lasts, and white noise."""
        white, share = self._rng.standard_normal(size), self.flight.lasting
        fresh, last = self._rng.standard_normal(size), self._errors.get(sensor)
        if last is not None:
            kept = math.exp(-(time_s - self._last_s[sensor]) / _ERROR_S)
            fresh = kept * last + math.sqrt(1.0 - kept**2) * fresh
        self._errors[sensor], self._last_s[sensor] = fresh, time_s
        return math.sqrt(share) * fresh + math.sqrt(1.0 - share) * white

    def _at(self, k: int) -> Iterator[Measurement]:
        time_s, fault, rng = float(self.times[k]), self.flight.fault, self._rng
        pose = self.poses[k]
        if self.flight.gyroscope:
            for j in range(max(k - 4, 1), k + 1):
                rate = self._swings[j - 1] @ self._swings[j].T
                turned = Rotation.from_matrix(rate).as_rotvec() / STEP_S
                noisy = turned + math.radians(0.01) * rng.standard_normal(3)
                yield RateMeasurement(float(self.times[j]), "gyro", noisy, math.radians(0.01))
        centre = pose.apply(RING.centre_m)
        away = float(np.linalg.norm(centre))
        odd = fault == "outliers" and rng.random() < 0.05
        if not (fault == "dead camera" and 60.0 < time_s < 100.0):
            sigma = np.r_[np.full(3, math.radians(0.15)), away * np.array([3e-4, 3e-4, 1.2e-3])]
            error = sigma * self._error("camera", 6, time_s)
            if fault == "offset" and 80.0 < time_s < 140.0:
                error[3:] += 7.1 * sigma[3:] * [1.0, 0.0, 1.0]
            if odd:
                error[:3] += rng.choice([0.2, 2.0]) * rng.standard_normal(3)
                error[3:] += 0.05 * rng.standard_normal() * pose.translation_m
            seen = self.poses[max(k - 10, 0)] if fault == "late stamps" else pose
            yield PoseMeasurement(time_s, "camera", seen.perturbed(error), np.diag(sigma**2))
        if k % 10 == 0 and away < 40.0:
            sigma = np.r_[np.full(3, math.radians(0.4)), np.full(3, 0.03 + 1e-3 * away)]
            error = sigma * self._error("stereo", 6, time_s)
            if fault == "stereo offset" and 80.0 < time_s < 140.0:
                error[3:] += [0.3, 0.2, 0.0]
            yield PoseMeasurement(time_s, "stereo", pose.perturbed(error), np.diag(sigma**2))
        if away < 15.0:
            yield self._ring(time_s, pose, centre)
        normal = pose.rotation @ RING.axis
        distance = float(normal @ centre / normal[2]) + 0.02 * float(rng.standard_normal())
        if odd:
            distance += rng.uniform(-2.0, 2.0)
        if distance > 0.0:
            surface = BeamSurface(RING.centre_m, RING.axis)
            yield RangeMeasurement(time_s, "laser", distance, 0.02, (surface,))

    def _ring(self, time_s: float, pose: Pose, centre: Array) -> RingMeasurement:
        """Both circles of the ellipse; an edge of another radius looks nearer or farther."""
        rng, away = self._rng, float(np.linalg.norm(centre))
        sigma, tilt = away * np.array([3e-4, 3e-4, 1e-3]), math.radians(0.4)
        place = centre + sigma * rng.standard_normal(3)
        if self.flight.fault == "wrong ring" and away < 4.0:
            place = 1.08 * place
        axis = pose.rotation @ RING.axis
        noise = tilt * rng.standard_normal(3)
        axis = axis + noise - (noise @ axis) * axis
        axis /= np.linalg.norm(axis)
        sight = place / np.linalg.norm(place)
        covariance = np.diag(np.r_[sigma**2, np.full(3, tilt**2)])
        other = 2.0 * (axis @ sight) * sight - axis
        both = (RingCandidate(place, a, covariance) for a in (axis, other))
        return RingMeasurement(time_s, "ring", tuple(both), RING)


def grid(count: int, seed: int) -> list[Flight]:
    """Flights of every kind: braking, spin, jitter, and errors that last or not."""
    rng = np.random.default_rng([24, seed])
    brakes, lasting = (None, 0.0, 1.0, 4.0, 10.0, 20.0), (0.0, 0.8, 0.5)
    return [
        Flight(
            braking_mm_s2=brakes[k % 6], lasting=lasting[k % 3],
            spin_deg_s=float(rng.choice([0.05, 0.3, 1.0, 3.0])),
            jitter_deg=float(rng.choice([0.0, 0.05, 0.1, 0.3, 0.5])),
            jitter_hz=float(np.exp(rng.uniform(math.log(0.15), math.log(30.0)))),
        )
        for k in range(count)
    ]  # fmt: skip


def faulty(fault: str) -> Flight:
    """A braking flight with a fault."""
    flight = Flight(braking_mm_s2=4.0, fault=fault)
    return replace(flight, thrust_m_s=0.08) if fault == "thrust" else flight
