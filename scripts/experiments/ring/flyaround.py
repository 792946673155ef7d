"""Zhai et al.'s simulation: a fly-around in the orbit plane, a ring of unknown size."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from experiments.frame import nees, show, table_of, two
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.ring.circle_pose import shape_of_circle
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.ring_pass import PassSize, ring_size_of_pass
from rendezview.sensors.ring.ring_size import RingSight, RingSize, ring_size

RADIUS_M, DISTANCE_M = 0.597, 1.68
PANEL_M = (8.0, 2.4)  # the method does not know it
RANGE_M = 12.0
CAMERA = Camera.from_fov(2048, 2048, np.radians(50.0))
# corners px, points of the ellipse px, range m: one σ each
LEVELS = ((0.02, 0.05, 0.002), (0.05, 0.1, 0.005), (0.1, 0.2, 0.01), (0.2, 0.4, 0.02))
ELLIPSE_POINTS = 300


def pose_at(angle_rad: float) -> Pose:
    """Camera from target: the target's +x (its docking side) turned by an angle about target z."""
    out = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    forward = -out
    down = np.array([0.0, 0.0, -1.0])
    rotation = np.vstack([np.cross(down, forward), down, forward])
    return Pose(rotation, rotation @ (-RANGE_M * out))


def sight(pose: Pose, level: tuple[float, float, float], rng: np.random.Generator) -> RingSight:
    """The panel's corners, the ring's ellipse and a laser range of one frame, with noise."""
    corner_px, point_px, range_m = level
    y, z = 0.5 * PANEL_M[0], 0.5 * PANEL_M[1]
    corners = pose.apply(np.array([[0, y, z], [0, -y, z], [0, y, -z], [0, -y, -z]]))
    measured = CAMERA.project(corners) + rng.normal(0.0, corner_px, (4, 2))
    axis = pose.rotation[:, 0]
    shape = shape_of_circle(CAMERA, pose.apply([DISTANCE_M, 0, 0]), axis, RADIUS_M)
    assert shape is not None
    points = Ellipse.from_shape(shape).points(ELLIPSE_POINTS)
    ellipse = Ellipse.fit(points + rng.normal(0.0, point_px, points.shape))
    assert ellipse is not None
    true_range = float(axis @ pose.translation_m) / axis[2]
    return RingSight(measured, ellipse, true_range + rng.normal(0.0, range_m), corner_px, range_m)


def error_of(size: RingSize | PassSize) -> np.ndarray:
    """Errors of R and D_f, metres."""
    return np.array([size.radius_m - RADIUS_M, size.distance_m - DISTANCE_M])


def run(
    *, seed: int = 61, frames: int = 60, passes: Annotated[int, "of each noise level"] = 8,
    picture: Annotated[Path | None, "PNG of the error curves of one pass"] = None,
) -> None:  # fmt: skip
    """Zhai et al.'s simulation: R and D_f of a ring of unknown size, from a fly-around.

    The chaser flies from -60° to 60° off the ring's axis, in the orbit plane, at 12 m. Each frame
    gives the four corners of a panel of unknown size, the ring's ellipse and one laser range, all
    with noise. R and D_f follow from a single frame (eq. 1–11) and from the whole pass.
    """
    angles = np.radians(np.linspace(-60.0, 60.0, frames))
    columns = ("σ corner, ellipse px, range m", "single R %", "single D_f %", "NEES / 2",
               "pass R %", "pass D_f %", "NEES / 2 ")  # fmt: skip
    rows = table_of(f"fly-around, seed {seed}, {frames} frames a pass", columns, left=7)
    curves = []
    for number, level in enumerate(LEVELS):
        single, whole, odd, odd_whole, none = [], [], [], [], 0
        for turn in range(passes):
            rng = np.random.default_rng([seed, number, turn])
            sights = [sight(pose_at(a), level, rng) for a in angles]
            curve = np.full((frames, 2), np.nan)
            for k, one in enumerate(sights):
                size = ring_size(CAMERA, one)
                if size is None:
                    none += 1
                    continue
                curve[k] = error_of(size)
                single.append(curve[k])
                odd.append(nees(curve[k], size.covariance) / 2.0)
            if turn == 0:
                curves.append(curve)
            size = ring_size_of_pass(CAMERA, sights)
            if size is None:
                raise SystemExit("a pass gave no answer")
            whole.append(error_of(size))
            odd_whole.append(nees(whole[-1], size.covariance[:2, :2]) / 2.0)
        share = 100.0 / np.array([RADIUS_M, DISTANCE_M])
        worst = np.abs(whole).max(axis=0) * share
        rows.add_row(
            f"{level[0]:.2f}, {level[1]:.2f}, {level[2]:.3f}" + (f" ({none} none)" if none else ""),
            *(two(errors * s) for errors, s in zip(np.abs(single).T, share, strict=True)),
            f"{np.median(odd):.2f} / {np.mean(odd):.2f}",
            f"{worst[0]:.4f}", f"{worst[1]:.4f}", f"{np.mean(odd_whole):.2f}",
        )  # fmt: skip
    show(rows, width=140)
    print("single frames: median / 95 %; passes: the worst of them")
    if picture:
        draw(np.degrees(angles), curves, picture)


def draw(angles_deg: np.ndarray, curves: list[np.ndarray], path: Path) -> None:
    """The error curves of one pass of each level."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="tight")
    axes = figure.subplots(1, 2)
    for level, curve in zip(LEVELS, curves, strict=True):
        for k, (axis, true) in enumerate(zip(axes, (RADIUS_M, DISTANCE_M), strict=True)):
            axis.plot(angles_deg, 100 * curve[:, k] / true, lw=1, label=f"{level[0]:.2f} px")
    for axis, name in zip(axes, ("R", "D_f"), strict=True):
        axis.set(xlabel="degrees off the ring's axis", ylabel=f"error of {name}, %", ylim=(-4, 4))
        axis.grid(alpha=0.3)
    axes[0].legend(title="σ of corners", fontsize=7)
    figure.savefig(path, dpi=100)
