"""Chooses between a circle's two poses: by prior attitude or by several edges of one plane.

The two axes lie on either side of the line of sight, equally far from it. Each rule gives a
number with a reason in words, or None with the missing knowledge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.geodesic import angle_between
from rendezview.sensors.ring.circle_pose import CirclePose

_ONE_POSE_SIGMAS = 2.0  # two axes nearer than that are one. Source: normal distribution, 5 %
# The other axis must be this much further from the prior. Source: by hand; see ring-accuracy
_MARGIN = 1.5
# By which the false pose must misfit more. Source: by construction, odds of e¹⁵
_PLANE_CHI2 = 30.0


@dataclass(frozen=True, slots=True)
class Choice:
    """Index of the true pose, None where it is undecided, and the reason."""

    index: int | None
    reason: str


def only_one(poses: Sequence[CirclePose]) -> Choice | None:
    """The choice of a single pose, or between two that agree within their errors; else None."""
    if len(poses) == 1:
        return Choice(0, "head-on: the two poses of the circle are one")
    apart = float(angle_between(poses[0].axis, poses[1].axis))
    if poses[0].covariance is not None:
        spread = poses[0].axis_sigma_rad
        if apart < _ONE_POSE_SIGMAS * spread:
            return Choice(
                0,
                f"nearly head-on: the two axes are {math.degrees(apart):.2f}° apart, "
                f"within the axis' error of {math.degrees(spread):.2f}°",
            )
    return None


def by_attitude(poses: Sequence[CirclePose], axis: npt.ArrayLike) -> Choice:
    """The pose whose axis is nearer to a known one (3,), camera frame."""
    off = angle_between([pose.axis for pose in poses], axis)
    best = int(np.argmin(off))
    single = only_one(poses)
    if single is not None:
        return Choice(best, single.reason)
    near, far = math.degrees(off[best]), math.degrees(off.max())
    evidence = f"{near:.1f}° from the prior attitude, the other {far:.1f}°"
    if off.max() < _MARGIN * off[best]:
        return Choice(None, f"the prior attitude does not distinguish the poses: {evidence}")
    return Choice(best, evidence)


def by_plane(misfits: Sequence[float]) -> Choice:
    """The pose that several edges of one plane fit; ``misfits`` are of `concentric.joint_poses`."""
    if len(misfits) < 2:
        return Choice(None, "one pose only")
    best = int(np.argmin(misfits))
    evidence = (
        f"the ring's edges fit it with χ² {misfits[best]:.0f}, "
        f"the other pose with {max(misfits):.0f}"
    )
    if max(misfits) < _PLANE_CHI2 + misfits[best]:
        return Choice(None, "the ring's edges fit both poses")
    return Choice(best, evidence)
