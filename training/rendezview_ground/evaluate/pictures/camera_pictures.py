"""What a lens does to a picture, and where the cameras of a rig stand."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from rendezview.geometry.camera import Camera
from rendezview.sensors.beacons import Rig
from rendezview_ground.evaluate.pictures.palette import (
    ACCURACY,
    ACTIVE,
    AXIS_COLOURS,
    ESTIMATE,
    GREEN,
    INK,
    MUTED,
    PURPLE,
    dress,
    new_figure,
    space_axes,
)

_GRID = 41  # points across the picture. Source: smooth contours
_LOOKS = (ESTIMATE, ACTIVE, GREEN, PURPLE)


def camera_picture(camera: Camera) -> Figure:
    """How far the lens moves the picture of each direction from that of a pinhole, px."""
    u, v = np.meshgrid(
        np.linspace(-0.5, camera.width - 0.5, _GRID), np.linspace(-0.5, camera.height - 0.5, _GRID)
    )
    points = np.column_stack([u.ravel(), v.ravel()])
    rays = camera.rays(points)
    ideal = camera.pinhole.project(np.where(np.isfinite(rays), rays, np.nan))
    moved = points - ideal
    size = np.hypot(*moved.T).reshape(u.shape)
    figure = new_figure(8.4, 8.4 * camera.height / camera.width * 0.82 + 1.5)
    axes = figure.add_subplot()
    dress(axes, x="column, px", y="row, px")
    axes.grid(False)
    if camera.is_distorted:  # of a pinhole the roundings, 1e-13 px, would be drawn
        filled = axes.contourf(u, v, size, 16, cmap=ACCURACY)
        lines = axes.contour(u, v, size, 8, colors="black", linewidths=0.6, alpha=0.6)
        axes.clabel(lines, fontsize=8, fmt="%.3g")
        bar = figure.colorbar(filled, ax=axes, pad=0.015, shrink=0.82)
        bar.set_label("moved by the lens, px", color=MUTED)
        bar.ax.tick_params(colors=MUTED, labelsize=9)
        some = np.arange(0, len(points), 1).reshape(u.shape)[2::6, 2::6].ravel()
        axes.quiver(
            *points[some].T, *moved[some].T, color=INK, angles="xy", width=0.003, pivot="middle"
        )
    else:
        axes.text(
            0.5,
            0.62,
            "no distortion",
            transform=axes.transAxes,
            color=INK,
            ha="center",
            fontsize=13,
        )
    axes.plot(camera.cx, camera.cy, "+", color=AXIS_COLOURS[0], markersize=15, markeredgewidth=2.2)
    axes.annotate(
        "principal point", (camera.cx, camera.cy), xytext=(9, -15), textcoords="offset points",
        color=INK, fontsize=9,
    )  # fmt: skip
    axes.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), aspect="equal")
    lens = f"{camera.lens_model.value}, {len(camera.distortion)} coefficients"
    axes.set_title(
        f"{camera.width} × {camera.height} px, focal length {camera.fx:.1f} × {camera.fy:.1f} px, "
        f"lens {lens if camera.is_distorted else 'pinhole'},\n"
        f"{_field_deg(camera):.1f}° from left to right border",
        color=INK, fontsize=10.5, loc="left",
    )  # fmt: skip
    return figure


def _field_deg(camera: Camera) -> float:
    """Angle between the left and the right border in the principal point's row; NaN if unknown."""
    ends = camera.rays([[-0.5, camera.cy], [camera.width - 0.5, camera.cy]])
    left, right = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    return math.degrees(math.acos(float(np.clip(left @ right, -1.0, 1.0))))


def rig_picture(rig: Rig) -> Figure:
    """The cameras of a rig in space, each with its axis and its field of view."""
    figure = new_figure(7.6, 6.4)
    axes = space_axes(figure)
    places = np.array([c.camera_from_rig.inverse().translation_m for c in rig.cameras])
    apart = float(np.ptp(places, axis=0).max()) if len(places) > 1 else 0.2
    reach = 0.6 * max(apart, 1e-3)
    for k, camera in enumerate(rig.cameras):
        colour = _LOOKS[k % len(_LOOKS)]
        rig_from_camera = camera.camera_from_rig.inverse()
        half = camera.reach
        corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        corners_m = reach * np.column_stack([corners, np.ones(4)])
        far = rig_from_camera.apply(corners_m)
        for corner in far:
            axes.plot(*np.stack([places[k], corner]).T, color=colour, linewidth=1.2)
        axes.plot(*np.vstack([far, far[:1]]).T, color=colour, linewidth=1.8)
        what = "" if camera.rms is None else f", residual {camera.rms:.3g}"
        axes.plot(
            *places[k][:, None], "os^D"[k % 4], color=colour, markersize=8,
            label=f"{camera.name}: f {camera.fx:.5g} {'px' if camera.size else 'm'}{what}",
        )  # fmt: skip
    baselines = [
        f"{rig.cameras[i].name}–{rig.cameras[j].name} {np.linalg.norm(places[i] - places[j]):.4g} m"
        for i in range(len(places))
        for j in range(i + 1, len(places))
    ]
    axes.set_title("baseline " + ", ".join(baselines), color=INK, fontsize=10.5, loc="left")
    axes.set_aspect("equal")
    axes.view_init(elev=-60.0, azim=-80.0)  # y is down, z away
    axes.legend(loc="upper left", fontsize=9, labelcolor=INK, frameon=False)
    return figure
