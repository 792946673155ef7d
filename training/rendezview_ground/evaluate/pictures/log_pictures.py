"""Curves of what a sensor or the filter said over time: distance, attitude, their σ, and status."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rendezview.errors import explained
from rendezview.geometry.pose import Array, Pose
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    ESTIMATE,
    GREEN,
    INK,
    MUTED,
    PROBLEM,
    PURPLE,
    TRUTH,
    dress,
    dress_legend,
    logarithmic,
    new_figure,
)

_OTHER_LOG = (KeyError, TypeError, ValueError, IndexError)  # where a line is of another log
_GOOD = ("ok", "tracking")
# Colour and hatch of a status, most frequent first: readable without colour.
_STATUS_LOOKS = ((PROBLEM, "///"), (TRUTH, "..."), (PURPLE, "xxx"), (MUTED, "---"))
_SENSOR_LOOKS = ((ESTIMATE, "o"), (ACTIVE, "s"), (GREEN, "^"), (PURPLE, "D"))
_LONG_S = 1e6  # s; seconds since 1970 are not readable on an axis. Source: eleven days
_WIDTH_IN, _PANEL_IN, _STRIP_IN = 9.6, 1.65, 0.75  # inches. Source: readable at half size


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Poses over time, NaN where there is none."""

    x: Array  # (N,) times or frame numbers
    x_label: str
    places_m: Array  # (N, 3) of the camera, target frame
    distance_m: Array  # (N,) of the target's origin
    distance_sigma_m: Array  # (N,)
    turned_rad: Array  # (N,) attitude against the first pose
    attitude_sigma_rad: Array  # (N,) per axis
    statuses: tuple[str, ...]

    @classmethod
    def of(
        cls,
        x: npt.ArrayLike,
        x_label: str,
        poses: Sequence[Pose | None],
        covariances: Sequence[npt.ArrayLike | None],
        statuses: Sequence[str],
    ) -> Track:
        """From ``camera_from_target`` and covariances, at least 6 × 6, of every frame."""
        count = len(poses)
        distance, sigma, turned, turn_sigma = (np.full(count, np.nan) for _ in range(4))
        places = np.full((count, 3), np.nan)
        first = next((pose for pose in poses if pose is not None), None)
        for k, (pose, given) in enumerate(zip(poses, covariances, strict=True)):
            if pose is None or first is None:
                continue
            places[k] = pose.inverse().translation_m
            distance[k] = np.linalg.norm(pose.translation_m)
            turned[k] = first.angle_to(pose)
            if given is not None and distance[k] > 0.0:
                covariance = np.asarray(given, dtype=np.float64)
                sight = pose.translation_m / distance[k]
                sigma[k] = math.sqrt(max(0.0, sight @ covariance[3:6, 3:6] @ sight))
                turn_sigma[k] = math.sqrt(max(0.0, np.trace(covariance[:3, :3]) / 3.0))
        return cls(
            np.asarray(x, dtype=np.float64), x_label, places, distance, sigma, turned, turn_sigma,
            tuple(statuses),
        )  # fmt: skip


def track_of_records(records: list[dict[str, Any]], where: str) -> Track:
    """The poses in a log's lines.

    Raises:
        RendezviewError: a line is no line of a log with poses.
    """
    with explained(f"{where}: not a log of poses (", ")", _OTHER_LOG):
        poses = [
            None
            if r["pose"] is None
            else Pose.from_quat_wxyz(r["pose"]["quat_wxyz"], r["pose"]["translation_m"])
            for r in records
        ]
        return Track.of(
            *times_of(records), poses, [r.get("covariance") for r in records],
            [
                str(r.get("status", "no pose" if r["pose"] is None else "ok")) for r in records
            ],
        )  # fmt: skip


def times_of(records: list[dict[str, Any]]) -> tuple[list[float], str]:
    """Times from the first, s, if all lines have one, else frame numbers; and the axis label."""
    times = [float(t) for r in records if isinstance(t := r.get("time_s"), int | float)]
    if len(times) == len(records):
        first = times[0] if abs(times[0]) > _LONG_S else 0.0
        label = "time, s" if first == 0.0 else f"time since {first:.3f}, s"
        return [time - first for time in times], label
    return [float(r.get("im_id", k)) for k, r in enumerate(records)], "frame"


def track_picture(track: Track, title: str) -> Figure:
    """Distance and attitude with their σ, and the status of every frame."""
    known = bool(np.isfinite(track.distance_sigma_m).any())
    panels = 4 if known else 2
    figure, grid = _panels(panels, title)
    dress(grid[0], y="distance, m")
    _curve(grid[0], track.x, track.distance_m, ESTIMATE)
    dress(grid[1], y="attitude since\nfirst pose, °")
    _curve(grid[1], track.x, np.degrees(track.turned_rad), GREEN)
    if known:
        dress(grid[2], y="1 σ of\ndistance, mm")
        _curve(grid[2], track.x, 1e3 * track.distance_sigma_m, ESTIMATE, "--")
        dress(grid[3], y="1 σ of attitude\nper axis, °")
        _curve(grid[3], track.x, np.degrees(track.attitude_sigma_rad), GREEN, "--")
        for axes in grid[2:4]:
            logarithmic(axes, "y")
    _status_strip(grid[-1], track.x, track.statuses, track.x_label)
    return figure


def ring_picture(records: list[dict[str, Any]], where: str) -> Figure:
    """A ring log: distance and tilt of the ring, the ellipses of each frame, and the status.

    Raises:
        RendezviewError: a line is not of `rendezview ring`.
    """
    with explained(f"{where}: not a log of `rendezview ring` (", ")", _OTHER_LOG):
        x, label = times_of(records)
        chosen = [_chosen_circle(r["poses"]) for r in records]
        distance = [math.nan if c is None else float(np.linalg.norm(c["centre_m"])) for c in chosen]
        tilt = [
            math.nan if c is None else math.degrees(math.acos(min(1.0, abs(c["axis"][2]))))
            for c in chosen
        ]
        best = [math.nan if r["ellipse"] is None else r["ellipses"][r["ellipse"]] for r in records]
        size = [e if isinstance(e, float) else max(e["semi_axes_px"]) for e in best]
        counts = [len(r["ellipses"]) for r in records]
        statuses = [str(r["status"]) for r in records]
    posed = any(c is not None for c in chosen)
    figure, grid = _panels(4 if posed else 2, "Docking ring")
    dress(grid[-3], y="half width of\nthe ellipse, px")
    _curve(grid[-3], np.array(x), np.array(size), ACTIVE)
    dress(grid[-2], y="ellipses")
    grid[-2].step(x, counts, where="mid", color=MUTED, linewidth=1.4)
    grid[-2].set_ylim(bottom=0.0)
    grid[-2].yaxis.set_major_locator(MaxNLocator(integer=True))
    if posed:
        dress(grid[0], y="distance, m")
        _curve(grid[0], np.array(x), np.array(distance), ESTIMATE)
        dress(grid[1], y="tilt of the axis\nfrom the boresight, °")
        _curve(grid[1], np.array(x), np.array(tilt), GREEN)
    _status_strip(grid[-1], np.array(x), statuses, label)
    return figure


def range_picture(records: list[dict[str, Any]], where: str) -> Figure:
    """A laser ranger's log: its ranges.

    Raises:
        RendezviewError: a range is not a number.
    """
    x, label = times_of(records)
    with explained(f"{where}: not a log of a ranger (", ")", _OTHER_LOG):
        ranges = [math.nan if r["range_m"] is None else float(r["range_m"]) for r in records]
    figure, grid = _panels(1, "Laser ranger")
    dress(grid[0], y="range, m")
    _curve(grid[0], np.array(x), np.array(ranges), ESTIMATE)
    statuses = ["no echo" if math.isnan(r) else "ok" for r in ranges]
    _status_strip(grid[-1], np.array(x), statuses, label)
    return figure


def measurement_picture(records: list[dict[str, Any]]) -> Figure | None:
    """Each measurement's squared error over its expectation, by sensor; None without any."""
    x, label = times_of(records)
    used = [
        (time, r["measurement"])
        for time, r in zip(x, records, strict=True)
        if r.get("measurement") is not None and r["measurement"].get("nis") is not None
    ]
    if not used:
        return None
    figure = new_figure(_WIDTH_IN, 3.4)
    axes = figure.add_subplot()
    dress(axes, x=label, y="squared error over expectation\n(1 is expected)")
    for k, name in enumerate(sorted({m["sensor"] for _, m in used})):
        colour, mark = _SENSOR_LOOKS[k % len(_SENSOR_LOOKS)]
        for accepted in (True, False):
            some = [
                (t, m["nis"] / max(1, m["degrees_of_freedom"]))
                for t, m in used
                if m["sensor"] == name and m["accepted"] == accepted
            ]
            if some:
                axes.plot(
                    *np.array(some).T, mark, color=colour, markersize=5,
                    markerfacecolor=colour if accepted else "none",
                    label=f"{name}: {len(some)} {'taken' if accepted else 'rejected'}",
                )  # fmt: skip
    axes.axhline(1.0, color=INK, linewidth=1.0, linestyle=":")
    logarithmic(axes, "y")
    dress_legend(axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9))
    return figure


def _chosen_circle(circles: list[dict[str, Any]]) -> dict[str, Any] | None:
    return next((circle for circle in circles if circle["chosen"]), None)


def _panels(count: int, title: str) -> tuple[Figure, list[Axes]]:
    """``count`` panels and a strip for the status below them, one axis along."""
    figure = new_figure(_WIDTH_IN, _PANEL_IN * count + _STRIP_IN + 0.5, title)
    grid = figure.subplots(
        count + 1, 1, sharex=True, height_ratios=[_PANEL_IN] * count + [0.45 * _STRIP_IN]
    )
    return figure, list(grid)


def _curve(axes: Axes, x: Array, y: Array, colour: str, line: str = "-") -> None:
    axes.plot(x, y, "." + line, color=colour, linewidth=1.4, markersize=4.5)


def _status_strip(axes: Axes, x: Array, statuses: Sequence[str], label: str) -> None:
    """A bar a frame, coloured and hatched by its status, with a legend of the counts."""
    dress(axes, x=label)
    axes.set_yticks([])
    axes.grid(False)
    step = float(np.median(np.diff(x))) if len(x) > 1 else 1.0
    counts = Counter(statuses)
    looks = iter(_STATUS_LOOKS * len(counts))
    for status, count in counts.most_common():
        good = status in _GOOD
        colour, hatch = (ESTIMATE, "") if good else next(looks)
        places = [k for k, one in enumerate(statuses) if one == status]
        axes.broken_barh(
            [(x[k] - 0.5 * step, step) for k in places], (0.0, 1.0), facecolor=colour,
            hatch=hatch, edgecolor="#0f141b" if hatch else colour, linewidth=0.0,
            label=f"{status}: {count} of {len(statuses)}",
        )  # fmt: skip
    axes.set_ylim(0.0, 1.0)
    axes.set_ylabel("status", color=MUTED, fontsize=10)
    dress_legend(
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(0.0, -1.1),
            ncols=min(5, len(counts)),
            fontsize=9,
            frameon=False,
        )
    )
