"""What a log of poses tells the ring sensor: where the ring is, how far, which way it faces."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath
from rendezview.io.pose_log import poses_by_frame
from rendezview.io.sequences.frame import Frame
from rendezview.io.target import DockingRing
from rendezview.sensors.ring.sensor import RingPrior


def priors_of_poses(path: StrPath, ring: DockingRing) -> Callable[[Frame], RingPrior | None]:
    """The prior of a frame, from the pose of its line in a log: see `poses_by_frame`."""
    return poses_by_frame(path, partial(prior_of_pose, ring=ring))


def prior_of_pose(pose: Pose, covariance: Array, ring: DockingRing) -> RingPrior:
    """Where the ring is for a pose ``camera_from_target`` with its covariance (6, 6).

    Raises:
        ValueError: the variance along the line of sight is not positive.
    """
    centre = pose.apply(ring.centre_m)
    sight = centre / np.linalg.norm(centre)
    # The centre R r + t moves by w × R r + v: along the line of sight by this (6,).
    along = np.concatenate([np.cross(pose.rotation @ ring.centre_m, sight), sight])
    variance = float(along @ covariance @ along)
    if not variance > 0.0:
        raise ValueError("covariance must be positive")
    return RingPrior(
        centre_m=centre, axis=pose.rotation @ ring.axis, range_sigma_m=math.sqrt(variance)
    )
