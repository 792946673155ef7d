"""Poses in files: one of its own, and with covariances by frame a log of ``track`` or ``fuse``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, TypeAdapter, field_validator

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath, checked, read_json
from rendezview.io.results import read_json_lines
from rendezview.io.sequences.frame import Frame

Known = TypeVar("Known")
_SAME_TIME_S = 1e-6  # s; Source: the times of one frame in two files differ by rounding only


class PoseKeys(BaseModel):
    """A pose, as files have it."""

    quat_wxyz: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
    translation_m: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]

    @field_validator("quat_wxyz")
    @classmethod
    def _turns(cls, quat: list[float]) -> list[float]:
        if not 1e-100 < math.hypot(*quat) < 1e100:  # beyond, its square is zero or infinite
            raise ValueError(f"must be a rotation, not {quat}")
        return quat

    @property
    def pose(self) -> Pose:
        """As the package has it."""
        return Pose.from_quat_wxyz(self.quat_wxyz, self.translation_m)


class _Line(BaseModel):
    """Keys that all logs of poses have in common, where they are there."""

    im_id: int | None = None
    time_s: FiniteFloat | None = None
    pose: PoseKeys | None = None
    covariance: list[list[float | None]] | None = None


_POSE, _LINE = TypeAdapter(PoseKeys), TypeAdapter(_Line)


def read_pose(path: StrPath, what: str, translation_m: Sequence[float] | None = None) -> Pose:
    """The pose of a JSON file: ``quat_wxyz`` and ``translation_m``, the latter with a default.

    Raises:
        RendezviewError: missing, or no pose.
    """
    content = read_json(path, what)
    if translation_m is not None and isinstance(content, dict):
        content = {"translation_m": translation_m} | content
    return checked(_POSE, content, f"{path}: no pose").pose


def read_poses(
    path: StrPath,
    of_line: Callable[[dict[str, Any]], Known],
    of: str = "`rendezview track` or `fuse`",
) -> list[Known]:
    """What is made of each line of a log of poses.

    Args:
        path: of the log.
        of_line: raises KeyError, TypeError or ValueError where a line is of another log.
        of: the command that writes such logs, for the message.

    Raises:
        RendezviewError: missing, or a line (named) that is of another log.
    """
    found = []
    for number, line in enumerate(read_json_lines(path), start=1):
        where = f"{path}: record {number}: no line of a log of poses ("
        checked(_LINE, line, where.removesuffix(" ("))
        with explained(where, f"): give that of {of}", (KeyError, TypeError, ValueError)):
            found.append(of_line(line))
    return found


def poses_by_frame(
    path: StrPath, use: Callable[[Pose, Array], Known], frames: Sequence[Frame] = ()
) -> Callable[[Frame], Known | None]:
    """What is made of the pose of a frame's line in a log.

    Lines belong to frames by ``im_id``, or by ``time_s`` where they have none; of several lines of
    a frame the last counts. A frame without a line, a pose or a covariance has none.

    Args:
        path: of the log.
        use: of camera_from_target and its covariance (6, 6); it raises ValueError where a
            covariance is of no use.
        frames: of which one at least must have a line, if the log has a pose.

    Raises:
        RendezviewError: missing, a line that is no pose's, or no line of these frames.
    """
    by_id: dict[int, Known] = {}
    timed: list[tuple[float, Known]] = []

    def take(line: dict[str, Any]) -> None:
        if line["pose"] is None or line["covariance"] is None or line.get("roll_ambiguous"):
            return
        known = use(*logged_pose(line))
        if line.get("im_id") is not None:
            by_id[int(line["im_id"])] = known
        else:
            timed.append((float(line["time_s"]), known))

    read_poses(path, take)
    times = np.array([time_s for time_s, _ in timed])

    def of_frame(frame: Frame) -> Known | None:
        if frame.im_id in by_id:
            return by_id[frame.im_id]
        if frame.time_s is None or not len(times):
            return None
        same = np.flatnonzero(np.abs(times - frame.time_s) < _SAME_TIME_S)
        return timed[same[-1]][1] if len(same) else None

    if frames and (by_id or timed) and not any(of_frame(frame) is not None for frame in frames):
        raise RendezviewError(
            f"{path}: none of its poses is of these frames: im_id, or time_s where there is none, "
            "must be theirs"
        )
    return of_frame


def logged_pose(line: dict[str, Any]) -> tuple[Pose, Array]:
    """The pose of a line that has one, and its covariance (6, 6).

    Raises:
        KeyError, TypeError, ValueError: the line is of another log.
    """
    pose = Pose.from_quat_wxyz(line["pose"]["quat_wxyz"], line["pose"]["translation_m"])
    covariance = np.array(line["covariance"], dtype=np.float64)
    if covariance.ndim != 2 or min(covariance.shape) < 6:
        raise ValueError("the covariance must be 6 × 6, or begin with that of the pose")
    return pose, covariance[:6, :6]
