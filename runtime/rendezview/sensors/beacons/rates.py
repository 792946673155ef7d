"""Rates of all six numbers, from filters over the readings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.estimation.rates import RateBank
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import Face
from rendezview.sensors.beacons.match.choice import FEW
from rendezview.sensors.beacons.pose.refinement import Refined
from rendezview.sensors.beacons.track import Doubt, Track, TrackingOptions

_FEWEST = 3  # readings that tell a motion. Source: by construction, two fix rates
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
    """Follows the poses of one target; see `rendezview.estimation.rates`."""

    def __init__(self) -> None:
        self._bank = RateBank()
        self._first_s = self._last_s = math.nan
        self._readings = 0
        self._scatter = np.full((6, 6), np.inf)  # of the last pose
        self.last: Rates | None = None

    def clear(self) -> None:
        """Forget the readings: the target was lost."""
        self._bank.clear()
        self._readings, self.last = 0, None

    def jumps(
        self, time_s: float, refined: Refined, light: Array, track: Track | None,
        options: TrackingOptions, doubt: Doubt,
    ) -> bool:  # fmt: skip
        """Whether a pose of few spots, which do not confirm each other, breaks with the readings.

        ``light`` (K,): χ² of each spot's size and brightness, added to that of the motion. The
        limit is lower after a gap of the ``track``, and in ``doubt`` about a spot, whose σ is no
        excuse then: it must agree as well as the last pose without doubt.
        """
        if len(light) > FEW:
            return False
        if doubt is Doubt.OTHER and self._readings < _FEWEST:
            return True
        if not self._readings or time_s - self._last_s > _LONGEST_S:
            return float(light.sum()) > options.jump_limit
        pose, (turn, share) = refined.camera_from_target, options.jump_floor
        place, covariance = pose.translation_m, (self._scatter if doubt else refined.scatter).copy()
        variances = covariance.reshape(-1)[::7]
        variances[:3] += turn**2
        variances[3:] += share**2 * float(place @ place)
        free = track is not None and not track.misses and not doubt
        limit = options.jump_limit if free else options.gap_limit
        limit -= float(light.sum())
        return limit < 0.0 or self._bank.surprise(time_s, pose, covariance) > limit

    def add(
        self, time_s: float, pose: Pose, covariance: Array, face: Face, slow: Array | None = None
    ) -> Rates | None:
        """Take a reading in; None while there is only one. ``face``: of the six numbers.

        ``slow`` (6, 6): what of the covariance hardly changes between readings.
        """
        if self._readings and time_s - self._last_s > _LONGEST_S:
            self.clear()
        found, self._scatter = self._bank.add(time_s, pose, covariance, slow), covariance
        self._first_s = self._first_s if self._readings else time_s
        self._last_s = time_s
        self._readings += 1
        if found is None:
            return None
        self.last = Rates(
            found.rates[3:], found.rates[:3], face.six_rates(pose, found.rates), found.covariance,
            time_s - self._first_s, self._readings,
        )  # fmt: skip
        return self.last
