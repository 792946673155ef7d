"""The memory of the ring's pose: a prior whose σ grows with time, and may be wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.geodesic import angle_between
from rendezview.sensors.ring.circle_pose import CirclePose

Array = npt.NDArray[np.float64]

# How fast a ring moves, one σ: a share of its range a second, in any direction. Source: a chosen
# limit, the closing rate of a fast approach and a half
_SPEED_SHARE = 0.03
_SPIN_RAD = math.radians(2.0)  # a second, one σ, of its axis. Source: a chosen limit
# Odds that what was given or remembered is wrong. Source: a chosen limit
_WRONG = 0.01
# ln of the largest to the smallest circle that a frame shows: a chance ellipse has any size of
# them. Source: by construction, 8 px to half a frame of 640
SIZES = 3.7


def odds_cost(square: Array, sigma_share: Array) -> Array:
    """−2 ln of the odds of a ring over a chance ellipse: misfits² (N,) and σ of the size's ln (N,).

    A ring's size is normal about the expected one, but for a share of wrong expectations; that of
    a chance ellipse is any.
    """
    density = SIZES / (math.sqrt(math.tau) * sigma_share)
    odds = (1.0 - _WRONG) * density * np.exp(-0.5 * square) + _WRONG
    return np.asarray(-2.0 * np.log(odds), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """Poses of the ring in an earlier frame: the chosen one, or both where none was chosen."""

    poses: tuple[CirclePose, ...]
    age_s: float = 0.0

    @property
    def size_sigma(self) -> float:
        """σ of the range now, as a share of it."""
        own = 0.0
        centre, covariance = self.poses[0].centre_m, self.poses[0].covariance
        if covariance is not None:
            own = math.sqrt(float(centre @ covariance[:3, :3] @ centre)) / float(centre @ centre)
        return math.hypot(own, _SPEED_SHARE * self.age_s)

    @property
    def is_spent(self) -> bool:
        """Whether it tells no more of the size than a chance ellipse's is spread."""
        return self.size_sigma * math.sqrt(math.tau) > SIZES

    def cost(self, centres_m: Array, axes: Array, size_sigma: Array) -> Array:
        """(N,) cost of ring poses, centres and axes (N, 3), σ of sizes (N,): see `odds_cost`.

        Place and axis tell a misfit, only the size tells a ring from other circles about its axis.
        """
        known = self.poses[0]
        far = float(np.linalg.norm(known.centre_m))
        ranges = np.linalg.norm(centres_m, axis=1)
        sigma = np.hypot(self.size_sigma, size_sigma)
        aside = angle_between(centres_m / ranges[:, None], known.centre_m / far)
        square = (np.log(ranges / far) ** 2 + aside**2) / sigma**2
        own = 2.0 * known.axis_sigma_rad**2  # of then, and of now
        turned = np.min([angle_between(axes, pose.axis) for pose in self.poses], axis=0)
        return odds_cost(square + turned**2 / (own + (_SPIN_RAD * self.age_s) ** 2), sigma)
