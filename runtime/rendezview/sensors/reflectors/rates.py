"""Rates of all six numbers, from filters of constant acceleration over the readings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.estimation.acceleration import AccelerationBank, AccelerationOptions
from rendezview.estimation.motion import extrapolate
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.reflectors.pattern import Face, SixNumbers

_STEP_S = 1e-4  # s, of the six numbers' slopes. Source: by construction, 1e-5 rad at 6°/s
_LONGEST_S = 30.0  # s between two readings: the motion is forgotten. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """Rates at the last reading.

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
    """Follows the poses of one target; see `rendezview.estimation.acceleration`."""

    def __init__(self, options: AccelerationOptions | None = None) -> None:
        self._bank = AccelerationBank(options)
        self._first_s = self._last_s = math.nan
        self._readings = 0

    def clear(self) -> None:
        """Forget the readings: the target was lost."""
        self._bank.clear()
        self._readings = 0

    def add(self, time_s: float, pose: Pose, covariance: Array, face: Face) -> Rates | None:
        """Take a reading in; None while there is only one. ``face``: of the six numbers."""
        if self._readings and time_s - self._last_s > _LONGEST_S:
            self.clear()
        found = self._bank.add(time_s, pose, covariance)
        self._first_s = self._first_s if self._readings else time_s
        self._last_s = time_s
        self._readings += 1
        if found is None:
            return None
        after, before = (
            _numbers(face.six_numbers(extrapolate(pose, found.rates, sign * _STEP_S)))
            for sign in (0.5, -0.5)
        )
        change = after - before
        change[3:] -= 2.0 * math.pi * np.rint(change[3:] / (2.0 * math.pi))
        return Rates(
            found.rates[3:], found.rates[:3], change / _STEP_S, found.covariance,
            time_s - self._first_s, self._readings,
        )  # fmt: skip


def _numbers(six: SixNumbers) -> Array:
    return np.array(
        [six.range_m, six.azimuth_rad, six.elevation_rad, six.roll_rad, six.pitch_rad, six.yaw_rad]
    )
