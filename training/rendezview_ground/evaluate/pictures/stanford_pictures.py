"""Stanford diagrams: errors against protection levels."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rendezview.geometry.pose import Array
from rendezview_ground.evaluate.pictures.palette import (
    ACCURACY,
    MUTED,
    PROBLEM,
    dress,
    new_figure,
)
from rendezview_ground.evaluate.stanford import Judged

_BINS = 70
_SHOWN_DEG = (1e-3, 180.0)
_SHOWN_M = (1e-4, 100.0)


def stanford_picture(judged: Judged, title: str) -> Figure:
    """Attitude and position: every pose at its error and its level.

    Poses below the diagonal have an error beyond their level. Those with an alarm are drawn in
    another colour and do not mislead.
    """
    figure = new_figure(10.4, 5.0, title)
    panels = figure.subplots(1, 2)
    degrees = math.degrees(1.0)
    for axes, errors, levels, shown, unit, what in (
        (panels[0], degrees * judged.attitude_error, degrees * judged.attitude_level,
         _SHOWN_DEG, "°", "attitude"),
        (panels[1], judged.position_error, judged.position_level, _SHOWN_M, "m", "position"),
    ):  # fmt: skip
        _panel(axes, errors, levels, judged, shown)
        dress(axes, x=f"{what} error, {unit}", y=f"protection level, {unit}")
    return figure


def _panel(
    axes: Axes, errors: Array, levels: Array, judged: Judged, shown: tuple[float, float]
) -> None:
    low, high = shown
    x, y = np.clip(errors, low, high), np.clip(levels, low, high)
    free = ~judged.alarm
    edges = np.geomspace(low, high, _BINS)
    axes.scatter(x[~free], y[~free], s=4, color=MUTED, alpha=0.35, linewidths=0, label="alarm")
    counts, _, _ = np.histogram2d(x[free], y[free], [edges, edges])
    with np.errstate(divide="ignore"):
        shade = np.ma.masked_invalid(np.log10(counts.T))
    axes.pcolormesh(edges, edges, shade, cmap=ACCURACY)
    wrong = judged.misleading & (errors > levels)
    axes.scatter(x[wrong], y[wrong], s=22, color=PROBLEM, marker="x", label="misleading")
    axes.plot(shown, shown, color=PROBLEM, linewidth=1.2)
    axes.set(xscale="log", yscale="log", xlim=shown, ylim=shown)
    title = (
        f"{int(free.sum())} without an alarm (colour: how many), "
        f"{int(wrong.sum())} misleading; grey: {int((~free).sum())} with one"
    )
    axes.set_title(title, color=MUTED, fontsize=8)
