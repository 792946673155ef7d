"""A frame with the result of its recognition drawn over it."""

from __future__ import annotations

import textwrap

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    AXIS_COLOURS,
    BACKGROUND,
    ESTIMATE,
    INK,
    PROBLEM,
)

_WIDTH_IN = 6.4  # inches; text takes the same share of the picture for every camera
_LEAST_PX, _MOST_PX = 640, 960  # px; widths of the shown frame
_LINE_IN = 0.3  # inches; height of a line of text
_BAR_IN = 3.4 * _LINE_IN  # inches; height of the status bar: three lines
_HALO = [withStroke(linewidth=3.0, foreground="black", alpha=0.7)]


def frame_overlay(
    image: npt.NDArray[np.uint8],
    observation: AppearanceObservation,
    camera: Camera,
    model: ViewModel,
    *,
    title: str = "",
    note: str = "",
    bad: bool = False,
) -> Figure:
    """Draw the frame with outline, axes of the CAD frame, bearing and status.

    Args:
        image: (height, width) grey levels of the camera.
        observation: of this frame. Without a pose, the picture shows its reason.
        camera: that took it.
        model: for the view centre and the length of the axes.
        title: text for the top left corner, such as the frame's number.
        note: text for the status bar, such as the error.
        bad: show the status as a problem, although there is a pose.

    Returns:
        A figure of the frame, 640 to 960 px wide, with the status bar below.
    """
    width_px = min(max(camera.width, _LEAST_PX), _MOST_PX)
    height_px = round(width_px * camera.height / camera.width)
    dpi = width_px / _WIDTH_IN
    bar_px = round(_BAR_IN * dpi)  # whole pixels, so that the frame is not resampled
    figure = Figure(figsize=(_WIDTH_IN, (height_px + bar_px) / dpi), dpi=dpi, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    share = bar_px / (height_px + bar_px)
    axes = figure.add_axes((0.0, share, 1.0, 1.0 - share))
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    axes.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5))
    axes.set_axis_off()
    if observation.silhouette is not None:
        for outline in observation.silhouette.outlines_px:
            closed = np.vstack([outline, outline[:1]])
            axes.plot(*closed.T, color=ACTIVE, linewidth=1.1)
    if observation.pose is not None:
        _draw_pose(axes, observation.pose, camera, model)
    if title:
        axes.text(
            0.018, 0.975, title, transform=axes.transAxes, va="top", color=INK, fontsize=15,
            path_effects=_HALO,
        )  # fmt: skip
    _status(figure.add_axes((0.0, 0.0, 1.0, share)), observation, model, note, bad)
    return figure


def _draw_pose(axes: Axes, pose: Pose, camera: Camera, model: ViewModel) -> None:
    centre = pose.apply(model.centre_m)
    tips = pose.apply(model.centre_m + 0.75 * model.target_radius_m * np.eye(3))
    if centre[2] <= 0.0:
        return
    x, y = camera.project(centre)
    # farther axes first
    for k in np.argsort(-tips[:, 2]):
        if tips[k, 2] <= 0.0:
            continue
        tip = camera.project(tips[k])
        axes.plot(
            (x, tip[0]), (y, tip[1]), color=AXIS_COLOURS[k], linewidth=2.4,
            solid_capstyle="round", path_effects=_HALO,
        )  # fmt: skip
        length = np.hypot(tip[0] - x, tip[1] - y)
        away = (tip - (x, y)) / max(length, 1.0) * 0.02 * camera.width
        axes.text(
            tip[0] + away[0], tip[1] + away[1], "XYZ"[k], color=AXIS_COLOURS[k], fontsize=12,
            fontweight="bold", ha="center", va="center", clip_on=True, path_effects=_HALO,
        )  # fmt: skip
    arm, gap = 0.035 * camera.width, 0.012 * camera.width
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        axes.plot(
            (x + gap * dx, x + arm * dx), (y + gap * dy, y + arm * dy), color=INK, linewidth=1.3,
            path_effects=_HALO,
        )  # fmt: skip


def _status(
    axes: Axes, observation: AppearanceObservation, model: ViewModel, note: str, bad: bool
) -> None:
    axes.set(xlim=(0.0, 1.0), ylim=(_BAR_IN / _LINE_IN, 0.0))
    axes.set_axis_off()
    bad = bad or observation.pose is None
    if observation.pose is None:
        reason = observation.reason or "no reason given"
        first = f"No pose: {observation.status.value}"
        rest = textwrap.wrap(reason[0].upper() + reason[1:], 56, max_lines=2, placeholder=" …")
    else:
        range_m = float(np.linalg.norm(observation.pose.apply(model.centre_m)))
        count = len(observation.active_nodes)
        first = f"Range {range_m:.2f} m{_sigma(observation, model)}, {count} active node"
        first += "" if count == 1 else "s"
        rest = textwrap.wrap(note, 56, max_lines=2, placeholder=" …")
    axes.add_patch(Rectangle((0.0, 0.0), 0.009, 9.0, color=PROBLEM if bad else ESTIMATE))
    for k, text in enumerate([first, *rest]):
        axes.text(
            0.026, 0.3 + k, text, va="top", color=PROBLEM if bad and k == 0 else INK,
            fontsize=15 if k == 0 else 13.5, fontweight="bold" if k == 0 else "normal",
        )  # fmt: skip


def _sigma(observation: AppearanceObservation, model: ViewModel) -> str:
    """± one σ of the range, if there is a covariance."""
    if observation.pose is None or observation.covariance is None:
        return ""
    arm = observation.pose.rotation @ model.centre_m
    sight = observation.pose.apply(model.centre_m)
    sight = sight / np.linalg.norm(sight)
    # centre = R c + t, so d(centre) = w × (R c) + v; its part along the line of sight
    slope = np.concatenate([np.cross(arm, sight), sight])
    return f" ± {np.sqrt(max(0.0, slope @ observation.covariance @ slope)):.2f}"
