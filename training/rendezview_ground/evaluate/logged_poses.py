"""Poses of a log of ``track`` beside the truth of its scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, nearest_alike
from rendezview.io.files import read_text
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
    judged = []
    for number, line in enumerate(read_text(log, "log (JSON lines)").splitlines(), start=1):
        try:
            entry = json.loads(line)
            truth, found = truths.get(entry["im_id"]), entry["pose"]
            if truth is None or found is None:
                continue
            pose = Pose.from_quat_wxyz(found["quat_wxyz"], found["translation_m"])
            error = nearest_alike(truth, pose, symmetries).delta_from(pose)
            judgement = judge(entry, error)
        except (ValueError, KeyError, TypeError, np.linalg.LinAlgError) as fault:
            raise RendezviewError(
                f"{log}: line {number} is not of a log of track ({fault}): give the file of "
                "track --log"
            ) from None
        if judgement is not None:
            judged.append(judgement)
    return judged
