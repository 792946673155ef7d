"""Results side by side: which share of the frames is right to within an error."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rendezview_ground.evaluate.evaluation import Evaluation
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    ESTIMATE,
    GREEN,
    MUTED,
    PURPLE,
    TRUTH,
    dress,
    legend_below,
    new_figure,
)

_LOOKS = (
    (ESTIMATE, "-"), (ACTIVE, "--"), (GREEN, "-."), (PURPLE, ":"), (TRUTH, (0, (5, 1, 1, 1, 1, 1))),
)  # fmt: skip
# Name in `PoseErrors`, factor, label, the range that is always shown.
_PANELS = (
    ("rotation_rad", math.degrees(1.0), "attitude error, °", (0.01, 180.0)),
    ("range_fraction", 100.0, "range error, %", (0.001, 100.0)),
    ("bearing_rad", 1000.0, "bearing error, mrad", (0.001, 100.0)),
)


def share_picture(evaluations: Mapping[str, Evaluation]) -> Figure:
    """Share of all frames whose error is below each value, for each of the results.

    Frames without a pose are below no value, so a curve ends at the share of frames with a pose.
    """
    figure = new_figure(10.4, 3.9, "Share of the frames with an error below …")
    grid = figure.subplots(1, len(_PANELS), sharey=True)
    for axes, (name, factor, label, shown) in zip(grid, _PANELS, strict=True):
        dress(axes, x=label, y="share of all frames, %" if axes is grid[0] else "")
        for k, (words, evaluation) in enumerate(evaluations.items()):
            colour, line = _LOOKS[k % len(_LOOKS)]
            _share(axes, factor * evaluation.values(name), shown, words, colour, line)
        axes.set(xscale="log", xlim=shown, ylim=(0.0, 101.0))
        axes.axhline(50.0, color=MUTED, linewidth=0.8, linestyle=":")
    legend_below(figure, grid[0])
    return figure


def _share(
    axes: Axes, errors: np.ndarray, shown: tuple[float, float], words: str, colour: str,
    line: object,
) -> None:  # fmt: skip
    known = np.sort(errors[np.isfinite(errors)])
    share = 100.0 * np.arange(1, len(known) + 1) / max(1, len(errors))
    x = np.concatenate([[shown[0]], np.maximum(known, shown[0]), [shown[1]]])
    y = np.concatenate([[0.0], share, [share[-1] if len(share) else 0.0]])
    axes.step(x, y, where="post", color=colour, linestyle=line, linewidth=1.8, label=words)
