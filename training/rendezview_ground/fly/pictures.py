"""Drawings of flights: the corridor in three views, errors with their levels, the footprint."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from rendezview.geometry.pose import Array
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    ESTIMATE,
    GREEN,
    GRID,
    INK,
    MUTED,
    PROBLEM,
    TRUTH,
    dress,
    legend_below,
    new_figure,
)
from rendezview_ground.fly.loop import Flight
from rendezview_ground.fly.setup import Setup

_SENSORS = ("camera", "ring", "reflectors", "stereo", "laser")
_MODES = {"hold": ACTIVE, "retreat": PROBLEM, "abort": PROBLEM}
_ENDS = {"contact": GREEN, "outside": PROBLEM}


def corridor_picture(flight: Flight, setup: Setup) -> Figure:
    """The chaser's port in the corridor: from the side, from above, and along the axis."""
    figure = new_figure(11.0, 7.6)
    grid = figure.add_gridspec(2, 3)
    guidance = setup.plan.guidance
    true = np.array([m.place_m for m in flight.moments])
    known = np.array([m.known_m for m in flight.moments])
    slope = math.tan(math.radians(guidance.corridor_deg))
    ends = np.array([0.0, float(true[:, 0].max())])
    half = guidance.corridor_m + slope * ends
    for row, (name, column) in enumerate((("right", 1), ("down", 2))):
        axes = figure.add_subplot(grid[row, :2])
        dress(axes, x="port to port, m", y=f"{name}, m")
        axes.fill_between(ends, -half, half, color=GRID, alpha=0.45, linewidth=0)
        for hold in guidance.holds_m:
            axes.axvline(hold, color=MUTED, linewidth=0.8, linestyle=":")
        axes.plot(known[:, 0], known[:, column], color=ESTIMATE, linewidth=1.0, label="fused state")
        axes.plot(true[:, 0], true[:, column], color=TRUTH, linewidth=1.6, label="truth")
        most = 1.3 * max(float(np.abs(true[:, column]).max()), guidance.corridor_m)
        axes.set_xlim(ends[1] * 1.02, -0.02 * ends[1])
        axes.set_ylim(most, -most) if column == 2 else axes.set_ylim(-most, most)
        if row == 0:
            legend_below(figure, axes)
    along = figure.add_subplot(grid[0, 2])
    dress(along, x="right, m", y="down, m")
    along.plot(true[:, 1], true[:, 2], color=TRUTH, linewidth=1.2)
    along.plot(*true[-1, 1:], "o", color=GREEN, markersize=6)
    along.add_patch(_ring(setup.plan.envelope.lateral_m))
    _square(along, 1.15 * max(float(np.abs(true[:, 1:]).max()), setup.plan.envelope.lateral_m))
    along.set_title("along the axis; circle: envelope", color=INK, fontsize=10)
    speed = figure.add_subplot(grid[1, 2])
    dress(speed, x="port to port, m", y="closing speed, m/s")
    speed.plot(true[:, 0], [m.true.closing_m_s for m in flight.moments], color=TRUTH, linewidth=1.4)
    speed.axhspan(*setup.plan.envelope.closing_m_s, color=GREEN, alpha=0.25, linewidth=0)
    speed.set_xlim(ends[1] * 1.02, -0.02 * ends[1])
    return figure


def error_picture(flight: Flight) -> Figure:
    """Errors of the fused state with their levels; sensors in use; rivals; modes; fuel."""
    figure = new_figure(11.0, 10.2)
    grid = figure.add_gridspec(5, 1, height_ratios=[3, 3, 2, 2, 2])
    times = np.array([m.time_s for m in flight.moments])
    factors = (("place, m", 1.0, "error_m", "level_m"),
               ("attitude, °", 180.0 / math.pi, "error_rad", "level_rad"))  # fmt: skip
    for row, (words, scale, error, level) in enumerate(factors):
        axes = figure.add_subplot(grid[row])
        dress(axes, y=words)
        for name, key, colour, width in (("protection level", level, PROBLEM, 1.2),
                                         ("error", error, ESTIMATE, 1.2)):  # fmt: skip
            values = scale * np.array([getattr(m, key) for m in flight.moments])
            axes.plot(times, values, color=colour, linewidth=width, label=name)
        axes.set_yscale("log")
        if row == 0:
            _legend(axes)
    axes = figure.add_subplot(grid[2])
    dress(axes, y="")
    rows = [*_SENSORS, "alarm"]
    for k, name in enumerate(rows):
        on = [m.time_s for m in flight.moments if (m.alarm if name == "alarm" else name in m.used)]
        axes.plot(on, np.full(len(on), k), "|", color=PROBLEM if name == "alarm" else GREEN,
                  markersize=8)  # fmt: skip
    axes.set_yticks(range(len(rows)), rows)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xlim(figure.axes[0].get_xlim())
    _rivals(figure.add_subplot(grid[3], sharex=figure.axes[0]), flight)
    axes = figure.add_subplot(grid[4], sharex=figure.axes[0])
    dress(axes, x="time, s", y="thrust, m/s")
    axes.plot(times, [m.spent_m_s for m in flight.moments], color=ACTIVE, linewidth=1.4)
    _shade_modes(axes, flight, times)
    axes.set_title("shaded: hold, retreat or abort", color=MUTED, fontsize=9, loc="left")
    return figure


def _rivals(axes: Axes, flight: Flight) -> None:
    """How likely the other hypotheses are that the filter weighs."""
    dress(axes, y="rivals,\nprobability")
    colours = (ACTIVE, ESTIMATE, PROBLEM, GREEN, MUTED)
    kinds = sorted({kind for moment in flight.moments for kind, _ in moment.rivals})
    for kind, colour in zip(kinds, colours, strict=False):
        some = [(m.time_s, p) for m in flight.moments for name, p in m.rivals if name == kind]
        axes.plot(*np.transpose(some), ".", color=colour, markersize=3, label=kind)
    axes.set_yscale("log")
    axes.set_ylim(1e-3, 1.5)
    if kinds:
        _legend(axes)


def _legend(axes: Axes) -> None:
    axes.legend(loc="upper right", fontsize=8, frameon=False, ncols=2, labelcolor=INK)


def _shade_modes(axes: Axes, flight: Flight, times: Array) -> None:
    step = float(times[1] - times[0]) if len(times) > 1 else 1.0
    for moment in flight.moments:
        if moment.mode in _MODES:
            axes.axvspan(moment.time_s, moment.time_s + step, color=_MODES[moment.mode],
                         alpha=0.25, linewidth=0)  # fmt: skip


def footprint_picture(lines: list[dict[str, Any]], setup: Setup) -> Figure:
    """Where the ports met, and each contact condition beside its limits."""
    figure = new_figure(11.0, 5.0)
    grid = figure.add_gridspec(2, 4)
    axes = figure.add_subplot(grid[:, :2])
    dress(axes, x="right, m", y="down, m")
    limits = setup.plan.envelope
    axes.add_patch(_ring(limits.lateral_m))
    for end, colour in _ENDS.items():
        places = [line["touch_m"] for line in lines if line["end"] == end]
        if places:
            axes.plot(*np.transpose(places), ".", color=colour, markersize=4, label=end)
    _square(axes, 1.15 * limits.lateral_m)
    axes.set_title("at contact; circle: envelope", color=INK, fontsize=10)
    angle = math.pi / 180.0
    conditions = (("tilt, °", "tilt_rad", angle, (0.0, limits.angle_deg)),
                  ("closing, m/s", "closing_m_s", 1.0, limits.closing_m_s),
                  ("lateral, m/s", "lateral_m_s", 1.0, (0.0, limits.lateral_m_s)),
                  ("rate, °/s", "across_rad_s", angle, (0.0, limits.rate_deg_s)))  # fmt: skip
    touches = [line["contact"] for line in lines if line["contact"]]
    for k, (words, key, unit, (low, high)) in enumerate(conditions):
        axes = figure.add_subplot(grid[k // 2, 2 + k % 2])
        dress(axes, x=words)
        axes.axvspan(low, high, color=GREEN, alpha=0.18, linewidth=0)
        axes.hist([touch[key] / unit for touch in touches], bins=24, color=ESTIMATE)
        axes.set_yticks([])
        room = 0.12 * (high - low)
        left, right = axes.get_xlim()
        axes.set_xlim(min(left, low - room), max(right, high + room))
    return figure


def _ring(radius: float) -> Circle:
    return Circle((0.0, 0.0), radius, fill=False, edgecolor=GREEN, linewidth=1.4)


def _square(axes: Axes, most: float) -> None:
    axes.set_xlim(-most, most)
    axes.set_ylim(most, -most)
    axes.set_aspect("equal")


def bars_picture(lines: list[dict[str, Any]]) -> Figure:
    """How the flights ended, by fault."""
    kinds = [None, *sorted({line["fault"] for line in lines if line["fault"]})]
    figure = new_figure(11.0, 0.6 + 0.38 * len(kinds) + 0.6)
    axes = figure.add_subplot()
    dress(axes, x="share of the flights, %")
    colours = {"contact": GREEN, "held": ESTIMATE, "aborted": ACTIVE, "outside": PROBLEM}
    for row, kind in enumerate(kinds):
        some = [line["end"] for line in lines if line["fault"] == kind]
        start = 0.0
        for end, colour in colours.items():
            share = 100.0 * some.count(end) / len(some)
            axes.add_patch(Rectangle((start, row - 0.35), share, 0.7, color=colour, linewidth=0,
                                     label=end if row == 0 else None))  # fmt: skip
            start += share
    axes.set_xlim(0.0, 100.0)
    axes.set_ylim(len(kinds) - 0.4, -0.6)
    axes.set_yticks(range(len(kinds)), [kind or "no fault" for kind in kinds])
    legend_below(figure, axes, columns=4)
    return figure
