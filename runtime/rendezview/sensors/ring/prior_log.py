"""What a log of poses tells the ring sensor: where the ring is, how far, which way it faces."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath
from rendezview.io.results import read_json_lines
from rendezview.io.sequences.frame import Frame
from rendezview.io.target import DockingRing
from rendezview.sensors.ring.sensor import RingPrior

_SAME_TIME_S = 1e-6  # s; Source: the times of one frame in two files differ by rounding only


def priors_of_poses(path: StrPath, ring: DockingRing) -> Callable[[Frame], RingPrior | None]:
    """The prior of a frame, from the pose of its line in a log of ``track`` or ``fuse``.

    Lines belong to frames by ``im_id``, or by ``time_s`` where they have none; of several lines of
    a frame the last counts. A frame without a line, a pose or a covariance has no prior.

    Raises:
        RendezviewError: missing, or a line that is no pose's.
    """
    by_id: dict[int, RingPrior] = {}
    timed: list[tuple[float, RingPrior]] = []
    for number, line in enumerate(read_json_lines(path), start=1):
        try:
            if line["pose"] is None or line["covariance"] is None or line.get("roll_ambiguous"):
                continue
            prior = _prior(line, ring)
            if line.get("im_id") is not None:
                by_id[int(line["im_id"])] = prior
            else:
                timed.append((float(line["time_s"]), prior))
        except (KeyError, TypeError, ValueError) as error:
            raise RendezviewError(
                f"{path}: record {number}: no line of a log of poses ({error}): give that of "
                "`rendezview track` or `fuse`"
            ) from error
    times = np.array([time_s for time_s, _ in timed])

    def of_frame(frame: Frame) -> RingPrior | None:
        if frame.im_id in by_id:
            return by_id[frame.im_id]
        if frame.time_s is None or not len(times):
            return None
        same = np.flatnonzero(np.abs(times - frame.time_s) < _SAME_TIME_S)
        return timed[same[-1]][1] if len(same) else None

    return of_frame


def _prior(line: dict[str, Any], ring: DockingRing) -> RingPrior:
    pose = Pose.from_quat_wxyz(line["pose"]["quat_wxyz"], line["pose"]["translation_m"])
    covariance = np.array(line["covariance"], dtype=np.float64)
    if covariance.ndim != 2 or min(covariance.shape) < 6:
        raise ValueError("the covariance must be 6 × 6, or begin with that of the pose")
    return prior_of_pose(pose, covariance[:6, :6], ring)


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
