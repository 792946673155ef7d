"""Curves over the frames, the cloud of points in space, and the computing time by stage."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rendezview.geometry.pose import Array
from rendezview.io.sequences import Frame
from rendezview.sensors.appearance import AppearanceObservation
from rendezview_ground.evaluate.evaluation import Evaluation, FrameResult
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    ESTIMATE,
    GREEN,
    INK,
    MUTED,
    PROBLEM,
    PURPLE,
    TRUTH,
    draw_axes,
    dress,
    dress_legend,
    legend_below,
    new_figure,
    space_axes,
)

_LOG_ABOVE = 30.0  # ratio of largest to median error above which an axis is logarithmic
_CURVES: tuple[tuple[str, tuple[tuple[str, str, float, str], ...]], ...] = (
    (
        "attitude, °",
        (
            ("rotation_rad", "rotation", math.degrees(1.0), ESTIMATE),
            ("direction_rad", "view direction", math.degrees(1.0), ACTIVE),
            ("roll_rad", "roll", math.degrees(1.0), PURPLE),
        ),
    ),
    ("range, %", (("range_fraction", "range", 100.0, ESTIMATE),)),
    ("bearing, mrad", (("bearing_rad", "bearing", 1000.0, GREEN),)),
)


def frame_axis(frames: Iterable[Frame | FrameResult]) -> tuple[Array, str]:
    """(F,) times of frames if all have one, else their numbers; and the label of the axis."""
    times = [(frame.time_s, frame.im_id) for frame in frames]
    if all(time_s is not None for time_s, _ in times):
        return np.array([time_s for time_s, _ in times]), "time, s"
    return np.array([im_id for _, im_id in times]), "frame"


def error_curves(evaluation: Evaluation, active_nodes: Sequence[int] | None = None) -> Figure:
    """Errors over the frames. Frames without a pose are gaps, marked by a band.

    Args:
        evaluation: of a sequence.
        active_nodes: number of active nodes in each frame of the evaluation.
    """
    x, x_label = frame_axis(evaluation.frames)
    missing = np.isnan(evaluation.values("rotation_rad"))
    panels = len(_CURVES) + (active_nodes is not None)
    figure = new_figure(9.6, 1.75 * panels + 0.6)
    grid = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (label, curves) in zip(grid, _CURVES, strict=False):
        dress(axes, y=label)
        drawn = [factor * evaluation.values(name) for name, _, factor, _ in curves]
        for values, (_, words, _, colour) in zip(drawn, curves, strict=True):
            axes.plot(
                x, values, ".-", color=colour, linewidth=1.4, markersize=4.5, label=words,
                zorder=3 if words != "rotation" else 2,
            )  # fmt: skip
        _scale(axes, np.concatenate(drawn))
        if len(curves) > 1:
            dress_legend(axes.legend(loc="upper right", ncols=3, fontsize=8.5))
    if active_nodes is not None:
        _node_bars(grid[-1], x, active_nodes)
        grid[-1].yaxis.get_major_locator().set_params(integer=True)
    grid[-1].set_xlabel(x_label, color=MUTED, fontsize=10)
    _bands(list(grid), x, missing)
    return figure


def observation_curves(
    x: npt.ArrayLike, ranges_m: npt.ArrayLike, active_nodes: npt.ArrayLike, *, x_label: str
) -> Figure:
    """Range and number of active nodes over the frames, without truth; NaN: no pose."""
    frames, ranges = np.asarray(x, dtype=np.float64), np.asarray(ranges_m, dtype=np.float64)
    figure = new_figure(9.6, 4.4)
    top, below = figure.subplots(2, 1, sharex=True)
    dress(top, y="range, m")
    top.plot(frames, ranges, ".-", color=ESTIMATE, linewidth=1.4, markersize=4.5)
    _node_bars(below, frames, active_nodes, x_label)
    _bands([top, below], frames, np.isnan(ranges))
    return figure


def _node_bars(axes: Axes, x: Array, active_nodes: npt.ArrayLike, x_label: str = "") -> None:
    dress(axes, x=x_label, y="active nodes")
    wide = 0.7 * float(np.median(np.diff(x))) if len(x) > 1 else 0.7
    axes.bar(x, np.asarray(active_nodes), width=wide, color=ACTIVE)
    axes.grid(False, axis="x")


def point_cloud(
    points_m: npt.ArrayLike,
    *,
    centre_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    target_radius_m: float = 1.0,
    estimates_m: npt.ArrayLike | None = None,
    truth_m: npt.ArrayLike | None = None,
    joined: bool = True,
) -> Figure:
    """Camera positions by the active nodes, and estimated and true tracks, in the target frame.

    Args:
        points_m: (N, 3) camera position by every active node of every frame.
        centre_m: (3,) view centre, where the target's axes are drawn.
        target_radius_m: length of these axes.
        estimates_m: (F, 3) estimated camera positions, NaN where there was no pose.
        truth_m: (F, 3) true ones.
        joined: the frames are a sequence, so lines join their positions.
    """
    figure = new_figure(6.2, 5.9)
    axes = space_axes(figure)
    line = "-" if joined else "none"
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    if len(points):
        axes.plot(
            *points.T,
            ".",
            color=ACTIVE,
            markersize=3.5,
            alpha=0.6,
            label="placed by an active node",
        )
    if truth_m is not None:
        axes.plot(
            *np.asarray(truth_m).T, "o", linestyle=line, color=TRUTH, linewidth=1.2, markersize=5.5,
            markerfacecolor="none", label="true camera",
        )  # fmt: skip
    if estimates_m is not None:
        axes.plot(
            *np.asarray(estimates_m).T, "o", linestyle=line, color=ESTIMATE, linewidth=1.6,
            markersize=3.5, label="estimated camera",
        )  # fmt: skip
    draw_axes(axes, np.asarray(centre_m, dtype=np.float64), target_radius_m)
    axes.set_aspect("equal")
    legend_below(figure, axes)
    return figure


def stage_picture(observations: Iterable[AppearanceObservation]) -> Figure:
    """Median and 95 % of the time of each stage, ms."""
    spent: dict[str, list[float]] = {}
    for observation in observations:
        for stage, time_ms in observation.stage_ms.items():
            spent.setdefault(stage, []).append(time_ms)
    figure = new_figure(9.6, 0.8 + 0.42 * max(len(spent), 1))
    axes = figure.add_subplot()
    dress(axes, x="time per frame, ms: median (bar) and 95 % (mark)")
    axes.grid(False, axis="y")
    names = list(spent)
    medians = [float(np.median(spent[name])) for name in names]
    high = [float(np.percentile(spent[name], 95.0)) for name in names]
    rows = np.arange(len(names))
    axes.barh(rows, medians, height=0.62, color=ESTIMATE)
    axes.plot(high, rows, "|", color=TRUTH, markersize=14, markeredgewidth=2.2)
    for row, median, upper in zip(rows, medians, high, strict=True):
        axes.annotate(
            f"{median:.2f}, 95 %: {upper:.2f}", (max(median, upper), row), xytext=(8, 0),
            textcoords="offset points", color=MUTED, fontsize=9, va="center",
        )  # fmt: skip
    axes.set_yticks(rows, names)
    axes.tick_params(axis="y", labelcolor=INK, length=0)
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.2 * max([*high, *medians, 1e-3]))
    return figure


def _scale(axes: Axes, values: Array) -> None:
    """A logarithmic axis if few large errors would hide the others."""
    known = values[np.isfinite(values) & (values > 0.0)]
    if known.size and known.max() > _LOG_ABOVE * np.median(known):
        axes.set_yscale("log")
        axes.set_ylim(bottom=max(float(known.min()), 1e-3 * float(np.median(known))))
    else:
        axes.set_ylim(bottom=0.0)


def _bands(panels: list[Axes], x: Array, missing: npt.NDArray[np.bool_]) -> None:
    """A band over each run of frames without a pose."""
    if not missing.any():
        return
    half = 0.5 * float(np.median(np.diff(x))) if len(x) > 1 else 0.5
    steps = np.diff(np.concatenate([[False], missing, [False]]).astype(int))
    for axes in panels:
        for first, after in zip(np.flatnonzero(steps > 0), np.flatnonzero(steps < 0), strict=True):
            axes.axvspan(x[first] - half, x[after - 1] + half, color=PROBLEM, alpha=0.22, zorder=0)
    panels[0].set_title(
        f"no pose in {int(missing.sum())} of {len(x)} frames (bands)",
        color=PROBLEM, fontsize=9.5, loc="left",
    )  # fmt: skip
