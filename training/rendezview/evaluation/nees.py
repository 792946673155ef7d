"""Errors of logged poses against their covariances."""

from __future__ import annotations

import json
from collections.abc import Sequence as Rows
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.evaluation.scores import RIGHT_RAD
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, nearest_alike
from rendezview.io.files import read_text
from rendezview.io.sequences import Sequence


def normalised_errors(sequence: Sequence, log: Path, symmetries: Rows[Symmetry] = ()) -> Array:
    """(N,) normalised error squared (NEES) eᵀ C⁻¹ e of the right poses of a log of ``track``.

    e is (rotation vector, translation) from the pose to the truth, camera frame, and C the logged
    covariance; 6 in the mean where C is right (Bar-Shalom et al. 2001, section 5.4). Poses more
    than 5° off are wrong ones, which the covariance does not cover.

    Raises:
        RendezviewError: the log cannot be read, or is none of ``track``.
    """
    truths = {frame.im_id: frame.camera_from_target for frame in sequence}
    squares = []
    for number, line in enumerate(read_text(log, "log (JSON lines)").splitlines(), start=1):
        try:
            entry = json.loads(line)
            truth = truths.get(entry["im_id"])
            if truth is None or entry["pose"] is None or entry["covariance"] is None:
                continue
            found = entry["pose"]
            pose = Pose.from_quat_wxyz(found["quat_wxyz"], found["translation_m"])
            covariance = np.array(entry["covariance"], dtype=np.float64)
            square = _square(truth, nearest_alike(pose, truth, symmetries), covariance)
        except (ValueError, KeyError, TypeError, np.linalg.LinAlgError) as error:
            raise RendezviewError(
                f"{log}: line {number} is not of a log of track ({error}): give the file of "
                "track --log"
            ) from None
        if square is not None:
            squares.append(square)
    return np.array(squares)


def _square(truth: Pose, pose: Pose, covariance: Array) -> float | None:
    turn = Rotation.from_matrix(truth.rotation @ pose.rotation.T).as_rotvec()
    if np.linalg.norm(turn) > RIGHT_RAD:
        return None
    error = np.concatenate([turn, truth.translation_m - pose.translation_m])
    return float(error @ np.linalg.solve(covariance, error))


def nees_text(squares: Array) -> str:
    """One line for a terminal."""
    if not len(squares):
        return "NEES: no right pose with a covariance in the log"
    return (
        f"NEES of {len(squares)} right poses: median {np.median(squares):.1f}, mean "
        f"{np.mean(squares):.1f} (5.3 and 6 where the covariance is right)"
    )
