"""The errors of a sequence and their statistics."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from rendezview.io.results import json_value
from rendezview_ground.evaluate.pose_errors import PoseErrors
from rendezview_ground.evaluate.surface import SurfaceErrors

WRONG_RAD = math.radians(5.0)

# On screen: name, factor to the unit, unit, decimals.
_SHOWN: dict[str, tuple[str, float, str, int]] = {
    "rotation_rad": ("rotation", math.degrees(1.0), "°", 2),
    "direction_rad": ("view direction", math.degrees(1.0), "°", 2),
    "roll_rad": ("roll", math.degrees(1.0), "°", 2),
    "translation_m": ("translation", 1.0, "m", 3),
    "range_fraction": ("range", 100.0, "%", 2),
    "bearing_rad": ("bearing", 1000.0, "mrad", 2),
    "speed_score": ("SPEED score", 1.0, "", 4),
}


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame with truth."""

    im_id: int
    name: str
    time_s: float | None  # of the frame in the sequence
    errors: PoseErrors | None  # None: no pose
    score: float | None = None
    computing_s: float | None = None
    surface: SurfaceErrors | None = None  # if the target's surface was given


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of one error over the frames with a pose; NaN if there are none."""

    median: float
    percentile_95: float
    largest: float
    mean: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Errors of every frame with truth, and their statistics."""

    frames: tuple[FrameResult, ...]  # in the order of the sequence
    notes: tuple[str, ...] = ()
    wrong_rad: float = WRONG_RAD

    @property
    def found(self) -> int:
        """Frames with a pose, right or wrong."""
        return sum(frame.errors is not None for frame in self.frames)

    @property
    def missing(self) -> tuple[int, ...]:
        """im_id of the frames without a pose."""
        return tuple(frame.im_id for frame in self.frames if frame.errors is None)

    @property
    def wrong(self) -> tuple[int, ...]:
        """im_id of the frames whose attitude error exceeds ``wrong_rad``."""
        return tuple(
            frame.im_id
            for frame in self.frames
            if frame.errors is not None and frame.errors.rotation_rad > self.wrong_rad
        )

    @property
    def found_share(self) -> float:
        """Frames with a pose over all frames with a truth."""
        return self.found / len(self.frames)

    @property
    def wrong_share(self) -> float:
        """Wrong poses over all frames with a truth."""
        return len(self.wrong) / len(self.frames)

    def values(self, name: str) -> npt.NDArray[np.float64]:
        """(N,) one error of each frame, by its name in `PoseErrors`; NaN: no pose."""
        return np.array(
            [math.nan if f.errors is None else getattr(f.errors, name) for f in self.frames]
        )

    def statistics(self, name: str) -> Statistics:
        """Statistics of one error over the frames with a pose."""
        return _statistics(self.values(name))

    @property
    def computing(self) -> Statistics:
        """Statistics of the computing time, s, over the frames that state it."""
        return _statistics(
            np.array([math.nan if f.computing_s is None else f.computing_s for f in self.frames])
        )

    @property
    def speed_score(self) -> float:
        """Mean SPEED score of the frames with a pose; SPEED requires one for each frame."""
        return self.statistics("speed_score").mean

    def as_table(self) -> Table:
        """The summary for a terminal."""
        count, degrees = len(self.frames), math.degrees(self.wrong_rad)
        lines = (
            f"{len(self.missing)} without a pose, "
            f"{len(self.wrong)} wrong by more than {degrees:g}° ({self.wrong_share:.1%})",
            *self.notes,
        )
        table = Table(
            title=f"{count} frames, {self.found} with a pose ({self.found_share:.1%})",
            title_justify="left",
            caption="\n".join(lines),
            caption_justify="left",
        )
        table.add_column("error of the poses found")
        for column in ("median", "95 %", "max", "unit"):
            table.add_column(column, justify="left" if column == "unit" else "right")
        for cells in summary_rows(self):
            table.add_row(*cells)
        return table

    def as_dict(self) -> dict[str, Any]:
        """All results, ready for JSON; unknown values are None. Names contain the units."""
        names = [*(f.name for f in fields(PoseErrors)), "speed_score"]
        whole: dict[str, Any] = {
            "frames": len(self.frames),
            "found": self.found,
            "found_share": self.found_share,
            "missing": list(self.missing),
            "wrong": list(self.wrong),
            "wrong_share": self.wrong_share,
            "wrong_rad": self.wrong_rad,
            "errors": {name: asdict(self.statistics(name)) for name in names},
            "computing_s": asdict(self.computing),
            "notes": list(self.notes),
            "per_frame": [
                asdict(frame) | {"status": "no pose" if frame.errors is None else "pose"}
                for frame in self.frames
            ],
        }
        return dict(json_value(whole))


def summary_rows(evaluation: Evaluation) -> list[tuple[str, str, str, str, str]]:
    """Rows of a table: error, median, 95 %, max and unit; – if there is no number."""
    rows = []
    for name, (label, factor, unit, decimals) in _SHOWN.items():
        rows.append((label, *_numbers(evaluation.statistics(name), factor, decimals), unit))
    rows.append(("computing time", *_numbers(evaluation.computing, 1e3, 1), "ms"))
    return rows


def _statistics(values: npt.NDArray[np.float64]) -> Statistics:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return Statistics(math.nan, math.nan, math.nan, math.nan)
    return Statistics(
        float(np.median(known)),
        float(np.percentile(known, 95.0)),
        float(known.max()),
        float(known.mean()),
    )


def _numbers(statistics: Statistics, factor: float, decimals: int) -> tuple[str, str, str]:
    numbers = (statistics.median, statistics.percentile_95, statistics.largest)
    a, b, c = (number_text(n, factor, decimals) for n in numbers)
    return a, b, c


def number_text(value: float | None, factor: float, decimals: int) -> str:
    """A number in its shown unit; – if it is unknown."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{factor * value:.{decimals}f}"
