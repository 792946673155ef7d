"""Rates of all six numbers from the last readings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import between
from rendezview.sensors.reflectors.pattern import SixNumbers


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """Straight lines through the last readings, at the last one.

    ``velocity_m_s`` and ``turn_rad_s`` are of the target in the camera frame:
    ``dt/dt`` and w with ``dR/dt = [w]× R``. ``six`` are the rates of the six numbers, in their
    own units a second.
    """

    velocity_m_s: Array  # (3,)
    turn_rad_s: Array  # (3,)
    six_per_s: Array  # (6,) range, azimuth, elevation, roll, pitch, yaw
    covariance: Array  # (6, 6) of (turn, velocity)
    span_s: float  # of the readings used
    readings: int


class RateEstimator:
    """Keeps the last readings and fits a line to each component."""

    def __init__(self, readings: int = 8, longest_s: float = 30.0) -> None:
        if readings < 2:
            raise ValueError(f"readings must be 2 or more, not {readings}")
        self._most, self._longest_s = readings, longest_s
        self._count = 0
        room = 8 * readings  # filled up before the last ones are moved to the front
        self._times = np.empty(room)
        self._rotations = np.empty((room, 3, 3))
        self._values = np.empty((room, 9))  # translation, six numbers
        self._covariances = np.empty((room, 6, 6))

    def clear(self) -> None:
        """Forget the readings: the target was lost."""
        self._count = 0

    def add(self, time_s: float, pose: Pose, six: SixNumbers, covariance: Array) -> Rates | None:
        """Take a reading in; None while there is only one."""
        if self._count == len(self._times):
            for kept in (self._times, self._rotations, self._values, self._covariances):
                kept[: self._most] = kept[-self._most :]
            self._count = self._most
        n = self._count
        self._times[n], self._rotations[n] = time_s, pose.rotation
        self._values[n, :3] = pose.translation_m
        self._values[n, 3:] = (
            six.range_m, six.azimuth_rad, six.elevation_rad,
            six.roll_rad, six.pitch_rad, six.yaw_rad,
        )  # fmt: skip
        self._covariances[n] = covariance
        self._count += 1
        first = max(self._count - self._most, 0)
        while time_s - self._times[first] > self._longest_s:
            first += 1
        used = slice(first, self._count)
        if self._count - first < 2:
            return None
        slopes, out = np.empty(12), np.empty((6, 6))
        _slopes(
            self._times[used], self._rotations[used], self._values[used], self._covariances[used],
            slopes, out,
        )  # fmt: skip
        return Rates(
            slopes[3:6], slopes[:3], slopes[6:], out,
            float(time_s - self._times[first]), self._count - first,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _slopes(
    times: Array, rotations: Array, values: Array, covariances: Array, slopes: Array,
    covariance: Array,
) -> None:  # fmt: skip
    """Least-squares slopes of (turn, translation, six numbers); angles across ±π are unwrapped."""
    n = times.shape[0]
    mean = np.mean(times)
    square = 0.0
    for i in range(n):
        square += (times[i] - mean) ** 2
    slopes[:] = 0.0
    covariance[:] = 0.0
    last = rotations[n - 1]
    for i in range(n):
        weight = (times[i] - mean) / square
        turn = between(rotations[i], last)
        for k in range(3):
            slopes[k] += weight * turn[k]
        for k in range(9):
            value = values[i, k] - values[n - 1, k]
            if k >= 4:
                value -= 2.0 * math.pi * np.rint(value / (2.0 * math.pi))
            slopes[3 + k] += weight * value
        for a in range(6):
            for b in range(6):
                covariance[a, b] += weight * weight * covariances[i, a, b]
