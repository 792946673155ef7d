"""The fitted path with its points, the plan and the corrections in space; and rates over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rendezview.geometry.pose import Array
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    AXIS_COLOURS,
    ESTIMATE,
    GREEN,
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

_ARROW = 0.25  # of the range; length of the arrow of the largest correction


def path_picture(records: Sequence[dict[str, Any]], points_m: Array) -> Figure:
    """Segments, prediction, plan and corrections in 3-D, in the plan's axes.

    Args:
        records: frames of a log, each with its ``trajectory``.
        points_m: (N, 3) points of the active nodes about the path's centre, plan's axes.
    """
    figure = new_figure(7.4, 6.6)
    axes = space_axes(figure)
    given = [r["trajectory"] for r in records if r["trajectory"].get("segment")]
    if len(points_m):
        axes.plot(*points_m.T, ".", color=ACTIVE, markersize=2.5, alpha=0.45, label="active nodes")
    places = np.array([t["segment"]["place_m"] for t in given]).reshape(-1, 3)
    axes.plot(*places.T, color=ESTIMATE, linewidth=1.8, label="fitted")
    ends = [t for k, t in enumerate(given) if t["ended"] or k == len(given) - 1]
    for k, t in enumerate(ends):
        ahead = np.array(t["segment"]["predicted_m"])
        words = "predicted" if k == 0 else None
        axes.plot(*ahead.T, "--", color=PURPLE, linewidth=1.2, label=words)
    planned = [
        np.array(t["segment"]["place_m"]) - t["correction"]["error_m"]
        for t in given
        if t.get("correction")
    ]
    if planned:
        axes.plot(*np.array(planned).T, color=TRUTH, linewidth=1.2, label="plan")
    corrected = [t for t in ends if t.get("correction") and t["correction"]["direction"]]
    if corrected:
        largest = max(np.linalg.norm(t["correction"]["delta_v_m_s"]) for t in corrected)
        far = float(np.median(np.linalg.norm(places, axis=1)))
        for k, t in enumerate(corrected):
            start = np.array(t["segment"]["place_m"])
            thrust = np.array(t["correction"]["delta_v_m_s"]) / largest * _ARROW * far
            words = f"correction, longest {1e3 * largest:.3g} mm/s" if k == 0 else None
            axes.quiver(*start, *thrust, color=PROBLEM, linewidth=2.0, label=words)
    if len(places):
        length_m = 0.2 * float(np.median(np.linalg.norm(places, axis=1)))
        draw_axes(axes, np.zeros(3), length_m)
    axes.set_aspect("equal")
    legend_below(figure, axes, size=9)
    return figure


def rate_picture(records: Sequence[dict[str, Any]], x: Array, x_label: str) -> Figure:
    """Speed, spin and distance to the plan over time, with one σ where it is known."""
    figure = new_figure(9.6, 6.0)
    top, middle, below = figure.subplots(3, 1, sharex=True)
    dress(top, y="speed, m/s")
    fitted = [(at, r["trajectory"]["segment"]) for at, r in zip(x, records, strict=True)]
    known = [(at, s) for at, s in fitted if s]
    if known:
        times = [at for at, _ in known]
        speeds = [np.linalg.norm(s["velocity_m_s"]) for _, s in known]
        top.plot(times, speeds, ".-", color=ESTIMATE, markersize=3.5)
    dress(middle, y="spin, °/s")
    spins = [(at, r["trajectory"].get("spin")) for at, r in zip(x, records, strict=True)]
    turning = [(at, s) for at, s in spins if s]
    if turning:
        times = [at for at, _ in turning]
        for k, letter in enumerate("XYZ"):
            rates = np.rad2deg([s["rate_rad_s"][k] for _, s in turning])
            sigmas = np.rad2deg([np.sqrt(s["covariance"][3 + k][3 + k]) for _, s in turning])
            middle.plot(times, rates, color=AXIS_COLOURS[k], linewidth=1.4, label=letter)
            middle.fill_between(
                times, rates - sigmas, rates + sigmas, color=AXIS_COLOURS[k], alpha=0.25
            )
        dress_legend(middle.legend(loc="upper right", ncols=3, fontsize=8.5))
    dress(below, x=x_label, y="off the plan, m")
    guided = [(at, r["trajectory"].get("correction")) for at, r in zip(x, records, strict=True)]
    off = [(at, c) for at, c in guided if c]
    if off:
        times = [at for at, _ in off]
        below.plot(times, [np.linalg.norm(c["error_m"]) for _, c in off], color=GREEN, label="now")
        ahead = [np.linalg.norm(c["predicted_error_m"]) for _, c in off]
        below.plot(times, ahead, "--", color=PURPLE, label="predicted, a segment ahead")
        below.set_ylim(bottom=0.0)
        dress_legend(below.legend(loc="upper right", ncols=2, fontsize=8.5))
    return figure
