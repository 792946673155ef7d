"""Comparison of several results of one sequence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from rendezview.io.results import json_value
from rendezview_ground.evaluate.evaluation import Evaluation, number_text
from rendezview_ground.evaluate.scores import scores

# Name in `Scores`, label, factor, unit, decimals.
_SCORES: tuple[tuple[str, str, float, str, int], ...] = (
    ("speed", "SPEED score, mean", 1.0, "", 4),
    ("speed_plus", "SPEED+ score, mean", 1.0, "", 4),
    ("speed_plus_all", "SPEED+ score, no pose: 180° and the whole range", 1.0, "", 4),
    ("right_share", "right: a pose within 5°", 100.0, "%", 1),
    ("wrong_share", "wrong: a pose beyond 10°", 100.0, "%", 1),
    ("rbot_share", "within 5 cm and 5° (RBOT)", 100.0, "%", 1),
    ("add_share", "ADD within 10 % of the diameter", 100.0, "%", 1),
    ("add_s_share", "ADD-S within 10 % of the diameter", 100.0, "%", 1),
    ("mssd_recall", "BOP recall by MSSD", 100.0, "%", 1),
    ("mspd_recall", "BOP recall by MSPD", 100.0, "%", 1),
)
# Name in `PoseErrors`, label, factor, unit, decimals.
_ERRORS: tuple[tuple[str, str, float, str, int], ...] = (
    ("rotation_rad", "rotation", math.degrees(1.0), "°", 3),
    ("translation_m", "translation", 1000.0, "mm", 1),
    ("range_fraction", "range", 100.0, "%", 3),
)


@dataclass(frozen=True, slots=True)
class Common:
    """Medians over the frames for which all results have a pose, so that they are comparable."""

    frames: int
    medians: dict[str, dict[str, float]]  # of each result, by the name in `PoseErrors`


def common_frames(evaluations: Mapping[str, Evaluation]) -> Common:
    """Errors over the frames that all results have.

    Raises:
        ValueError: no evaluations, or of different sequences.
    """
    parts = list(evaluations.values())
    if not parts or any(
        [f.im_id for f in part.frames] != [f.im_id for f in parts[0].frames] for part in parts
    ):
        raise ValueError("results are comparable over one sequence only")
    both = np.all([np.isfinite(part.values("rotation_rad")) for part in parts], axis=0)
    medians = {
        name: {
            error: float(np.median(part.values(error)[both])) if both.any() else math.nan
            for error, *_ in _ERRORS
        }
        for name, part in evaluations.items()
    }
    return Common(int(both.sum()), medians)


def score_table(evaluation: Evaluation) -> Table:
    """Table of the challenges' scores of one result, for a terminal."""
    table = Table(title="scores", title_justify="left")
    table.add_column("over all frames; SPEED, SPEED+ mean: over the poses found")
    for header in ("score", "unit"):
        table.add_column(header, justify="left" if header == "unit" else "right")
    found = scores(evaluation)
    for name, label, factor, unit, decimals in _SCORES:
        value = getattr(found, name)
        if value is not None:
            table.add_row(label, number_text(value, factor, decimals), unit)
    return table


def comparison_table(evaluations: Mapping[str, Evaluation]) -> Table:
    """Table with a column per result, for a terminal.

    Raises:
        ValueError: see `common_frames`.
    """
    common = common_frames(evaluations)
    parts = list(evaluations.values())
    degrees = math.degrees(parts[0].wrong_rad)
    table = Table(title=f"{len(parts[0].frames)} frames", title_justify="left")
    table.add_column("")
    table.add_column("unit")
    for name in evaluations:
        table.add_column(name, justify="right", overflow="fold")

    def row(label: str, unit: str, cells: list[str]) -> None:
        table.add_row(label, unit, *cells)

    row("frames with a pose", "", [str(part.found) for part in parts])
    row(f"wrong by more than {degrees:g}°", "", [str(len(part.wrong)) for part in parts])
    for error, label, factor, unit, decimals in _ERRORS:
        statistics = [part.statistics(error) for part in parts]
        for what, field in (("median", "median"), ("95 %", "percentile_95")):
            numbers = [number_text(getattr(s, field), factor, decimals) for s in statistics]
            row(f"{label}, {what}", unit, numbers)
    table.add_section()
    for error, label, factor, unit, decimals in _ERRORS:
        numbers = [
            number_text(common.medians[name][error], factor, decimals) for name in evaluations
        ]
        row(f"{label}, median of the {common.frames} frames all have", unit, numbers)
    table.add_section()
    found = [scores(part) for part in parts]
    for name, label, factor, unit, decimals in _SCORES:
        values = [getattr(result, name) for result in found]
        if any(value is not None for value in values):
            row(label, unit, [number_text(value, factor, decimals) for value in values])
    row("computing time, median", "ms", [number_text(p.computing.median, 1e3, 2) for p in parts])
    return table


def comparison_dict(evaluations: Mapping[str, Evaluation]) -> dict[str, Any]:
    """All results, ready for JSON; names contain the units.

    Raises:
        ValueError: see `common_frames`.
    """
    common = common_frames(evaluations)
    return {
        "results": [
            {"file": name, **part.as_dict(), "scores": asdict(scores(part))}
            for name, part in evaluations.items()
        ],
        "common_frames": common.frames,
        "common_medians": json_value(common.medians),
    }
