"""A prior, how far off it may be, and which poses are near enough to be the answer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.judge.found import Found

# Of a range that is told, by a prior or with a place. Source: by construction, as a box that is a
# fifth wrong
RANGE_ERROR = 0.25
_SIGMAS = 3.0  # of a pose beyond the error of its prior. Source: normal distribution, 99.7 %


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """A prior, and how far off its attitude may be."""

    prior: Pose  # camera_from_target
    error_rad: float
    centre_m: Array  # (3,) the view centre, target frame

    @property
    def furthest_rad(self) -> float:
        """How far from the prior a pose may be: its error and a tenth, and a degree."""
        return float(1.1 * self.error_rad + np.deg2rad(1.0))

    def wider(self, by_rad: float) -> Near:
        """The same with a larger error."""
        return replace(self, error_rad=self.error_rad + by_rad)

    def holds(self, pose: Pose) -> bool:
        """Whether a pose is near enough.

        An error of the range displaces the outline by as many pixels as an attitude error of as
        many radians, so its share has the same bound, a quarter at most.
        """
        range_m = float(np.linalg.norm(self.prior.apply(self.centre_m)))
        most_rad = self.furthest_rad
        off = float(np.linalg.norm(pose.apply(self.centre_m))) / max(range_m, 1e-9)
        return abs(off - 1.0) <= min(RANGE_ERROR, most_rad) and pose.angle_to(self.prior) < most_rad

    def bounded(self, found: Found | None) -> Found | None:
        """What was found, unless it is farther off than the error and three σ of the pose."""
        if found is None or found.best.covariance is None:
            return None
        sigma_rad = math.sqrt(float(np.linalg.eigvalsh(found.best.covariance[:3, :3])[-1]))
        apart = found.best.pose.angle_to(self.prior)
        return found if apart <= self.error_rad + _SIGMAS * sigma_rad else None
