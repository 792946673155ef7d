"""Chooses between a circle's two poses: by prior attitude, by a point off the plane, by motion.

The two axes lie on either side of the line of sight, equally far from it. Each rule gives a
number with a reason in words, or None with the missing knowledge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.sensors.ring.circle_pose import CirclePose, tangent_basis

Array = npt.NDArray[np.float64]

_ONE_POSE_SIGMAS = 2.0  # two axes nearer than that are one. Source: normal distribution, 5 %
# The other axis must be this much further from the prior. Source: by hand; see ring-accuracy
_MARGIN = 1.5
# By which the false pose must misfit more. Source: by construction, odds of e¹⁵
_PLANE_CHI2 = 30.0
_MOTION_LEAST_RAD = math.radians(2.0)  # the false axis must have turned by so much. Source: by hand
_MOTION_SHARE = 0.35  # and the true one by no more than this of it. Source: by hand


@dataclass(frozen=True, slots=True)
class Choice:
    """Index of the true pose, None where it is undecided, and the reason."""

    index: int | None
    reason: str


def only_one(poses: Sequence[CirclePose]) -> Choice | None:
    """The choice of a single pose, or between two that agree within their errors; else None."""
    if len(poses) == 1:
        return Choice(0, "head-on: the two poses of the circle are one")
    apart = angle_between(poses[0].axis, poses[1].axis)
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
    known = np.asarray(axis, dtype=np.float64)
    angles = [angle_between(pose.axis, known) for pose in poses]
    best = int(np.argmin(angles))
    single = only_one(poses)
    if single is not None:
        return Choice(best, single.reason)
    near, far = math.degrees(angles[best]), math.degrees(max(angles))
    evidence = f"{near:.1f}° from the prior attitude, the other {far:.1f}°"
    if max(angles) < _MARGIN * angles[best]:
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


@dataclass(slots=True)
class MotionChooser:
    """Follows both axes over frames: on a target that does not turn, only the false axis turns.

    As the camera moves round the ring (or the ring across the picture) the true axis stays and the
    false one swings with the line of sight. Holds for a camera that keeps its own attitude.
    """

    _axes: list[list[Array]] = field(default_factory=lambda: [[], []])
    _noise: list[float] = field(default_factory=list)
    decided: int | None = None

    def update(self, poses: Sequence[CirclePose]) -> Choice:
        """Take in both poses of the circle in a frame."""
        single = only_one(poses)
        if single is not None:
            return single
        axes = [pose.axis for pose in poses]
        order = (0, 1)
        if self._axes[0]:
            last = [track[-1] for track in self._axes]
            straight = axes[0] @ last[0] + axes[1] @ last[1]
            crossed = axes[0] @ last[1] + axes[1] @ last[0]
            if crossed > straight:
                order = (1, 0)
        for track, k in zip(self._axes, order, strict=True):
            track.append(axes[k])
        self._noise.append(poses[0].axis_sigma_rad)
        swings = [_swing(track) for track in self._axes]
        still = int(np.argmin(swings))
        noise = float(np.median(self._noise))
        evidence = (
            f"by motion: over {len(self._noise)} frames its axis turned by "
            f"{math.degrees(swings[still]):.2f}°, the other's by {math.degrees(max(swings)):.2f}°"
        )
        if (
            max(swings) > max(_MOTION_LEAST_RAD, 6.0 * noise)
            and swings[still] < _MOTION_SHARE * max(swings) + noise
        ):
            self.decided = still
        elif self.decided is None:
            return Choice(
                None, "no prior attitude, and the motion does not decide yet: " + evidence
            )
        assert self.decided is not None
        return Choice(order.index(self.decided) if order != (0, 1) else self.decided, evidence)


def _swing(axes: Sequence[Array]) -> float:
    """How far a set of directions reaches from their mean, root mean square, rad."""
    stacked = np.array(axes)
    mean = stacked.mean(axis=0)
    basis = tangent_basis(mean / np.linalg.norm(mean))
    return 2.0 * math.sqrt(float(np.mean(np.sum((stacked @ basis) ** 2, axis=1))))


def angle_between(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Angle of two directions (3,), rad."""
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    return math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second))
