"""Errors against protection levels: what a Stanford diagram counts.

Walter, Hansen & Enge, *Validation of the WAAS MOPS integrity equation*, ION AM 1999.
"""

from __future__ import annotations

import math
from collections.abc import Sequence as Rows
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import betaincinv

from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.sequences import Sequence
from rendezview_ground.evaluate.logged_poses import of_logged_poses


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Poses with their errors, levels and alarms. A pose of no target has an infinite error."""

    attitude_error: Array  # (N,) rad
    attitude_level: Array  # (N,) rad
    position_error: Array  # (N,) m
    position_level: Array  # (N,) m
    alarm: npt.NDArray[np.bool_]  # (N,)

    def __len__(self) -> int:
        return len(self.alarm)

    @property
    def misleading(self) -> npt.NDArray[np.bool_]:
        """(N,) an error beyond its level, and no alarm."""
        return ~self.alarm & (self.ratio > 1.0)

    @property
    def ratio(self) -> Array:
        """(N,) the larger of both errors over their levels."""
        with np.errstate(invalid="ignore"):  # an infinite error of an infinite level: alarmed
            attitude = self.attitude_error / self.attitude_level
            position = self.position_error / self.position_level
        return np.nan_to_num(np.fmax(attitude, position), nan=0.0, posinf=np.inf)

    def of(self, chosen: npt.NDArray[np.bool_]) -> Judged:
        """Some of the poses."""
        return Judged(
            self.attitude_error[chosen],
            self.attitude_level[chosen],
            self.position_error[chosen],
            self.position_level[chosen],
            self.alarm[chosen],
        )


def upper_limit(count: int, of: int, confidence: float = 0.95) -> float:
    """Upper limit of a probability after ``count`` events in ``of`` trials (Clopper & Pearson)."""
    return 1.0 if count >= of else float(betaincinv(count + 1, of - count, confidence))


def judged_log(sequence: Sequence, log: Path, symmetries: Rows[Symmetry] = ()) -> Judged | None:
    """The poses of a log of ``track --integrity-risk`` beside the truth of its scene.

    ``None``: the log has no protection levels.

    Raises:
        RendezviewError: the log cannot be read, or is none of ``track``.
    """

    def row(entry: dict[str, Any], error: Array) -> list[float] | None:
        if "protection" not in entry:
            return None
        levels = entry["protection"]
        return [
            float(np.linalg.norm(error[:3])),
            _level(levels["attitude_rad"]),
            float(np.linalg.norm(error[3:])),
            _level(levels["position_m"]),
            float(levels["alarm"]),
        ]

    rows = of_logged_poses(sequence, log, symmetries, row)
    if not rows:
        return None
    turn, turn_level, move, move_level, alarm = np.array(rows).T
    return Judged(turn, turn_level, move, move_level, alarm > 0.5)


def _level(value: float | None) -> float:
    return math.inf if value is None else float(value)


def stanford_text(judged: Judged) -> str:
    """One line for a terminal."""
    wrong, alarmed, of = int(judged.misleading.sum()), int(judged.alarm.sum()), len(judged)
    free = 100.0 * (1.0 - alarmed / of)
    return (
        f"protection levels of {of} poses: {wrong} misleading (below {upper_limit(wrong, of):.2g} "
        f"with 95 % confidence), {alarmed} with an alarm, {free:.1f} % available"
    )


def stanford_dict(judged: Judged) -> dict[str, float]:
    """The counts as JSON."""
    wrong, of = int(judged.misleading.sum()), len(judged)
    return {
        "poses": of,
        "misleading": wrong,
        "misleading_below": upper_limit(wrong, of),
        "alarms": int(judged.alarm.sum()),
    }
