"""Poses of a log of ``track`` beside the truth of its scene."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any, TypeVar

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, nearest_alike
from rendezview.io.pose_log import read_poses
from rendezview.io.sequences import Sequence

_Judgement = TypeVar("_Judgement")


def of_logged_poses(
    sequence: Sequence,
    log: Path,
    symmetries: Rows[Symmetry],
    judge: Callable[[dict[str, Any], Array], _Judgement | None],
) -> list[_Judgement]:
    """What ``judge`` makes of the logged entry and the error of each pose; ``None`` is left out.

    The error (6,) is (rotation vector, translation) from the pose to the truth, camera frame; of
    true poses that look alike, the nearest one counts. The pose stays, for its covariance is that
    of its own origin.

    Raises:
        RendezviewError: the log cannot be read, or is none of ``track``.
    """
    truths = {frame.im_id: frame.camera_from_target for frame in sequence}

    def of_line(entry: dict[str, Any]) -> _Judgement | None:
        truth, found = truths.get(entry["im_id"]), entry["pose"]
        if truth is None or found is None:
            return None
        pose = Pose.from_quat_wxyz(found["quat_wxyz"], found["translation_m"])
        return judge(entry, nearest_alike(truth, pose, symmetries).delta_from(pose))

    found = read_poses(log, of_line, "`rendezview track`")
    return [judgement for judgement in found if judgement is not None]
