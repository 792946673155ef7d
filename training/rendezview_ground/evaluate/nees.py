"""Errors of logged poses against their covariances."""

from __future__ import annotations

from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.sequences import Sequence
from rendezview_ground.evaluate.logged_poses import of_logged_poses
from rendezview_ground.evaluate.scores import RIGHT_RAD


def normalised_errors(sequence: Sequence, log: Path, symmetries: Rows[Symmetry] = ()) -> Array:
    """(N,) normalised error squared (NEES) eᵀ C⁻¹ e of the right poses of a log of ``track``.

    e is (rotation vector, translation) from the pose to the truth, camera frame, and C the logged
    covariance; 6 in the mean where C is right (Bar-Shalom et al. 2001, section 5.4). Poses more
    than 5° off are wrong ones, which the covariance does not cover.

    Raises:
        RendezviewError: the log cannot be read, or is none of ``track``.
    """

    def square(entry: dict[str, Any], error: Array) -> float | None:
        if entry["covariance"] is None or np.linalg.norm(error[:3]) > RIGHT_RAD:
            return None
        covariance = np.array(entry["covariance"], dtype=np.float64)
        return float(error @ np.linalg.solve(covariance, error))

    return np.array(of_logged_poses(sequence, log, symmetries, square))


def nees_text(squares: Array) -> str:
    """One line for a terminal."""
    if not len(squares):
        return "NEES: no right pose with a covariance in the log"
    return (
        f"NEES of {len(squares)} right poses: median {np.median(squares):.1f}, mean "
        f"{np.mean(squares):.1f} (5.3 and 6 where the covariance is right)"
    )
