"""Zhai et al.'s simulation: flying round in the orbit plane, R and D_f of a ring of unknown size.

    python -m experiments ring-flyaround --seed 61

The chaser goes round the target's docking side in the orbit plane, from -60° to 60° off the ring's
axis, at 12 m. Each of the frames gives the four corners of a panel of unknown size, the ring's
ellipse and one laser range, all with noise; R and D_f follow from the frame alone (eq. 1–11) and
from the whole pass. Table over noise levels; with --picture the error curves.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.ring.circle_pose import shape_of_circle
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.ring_size import RingSight, ring_size, ring_size_of_pass

RADIUS_M, DISTANCE_M = 0.597, 1.68
PANEL_M = (8.0, 2.4)  # not told to the method
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
    corner_px, point_px, range_m = level
    y, z = 0.5 * PANEL_M[0], 0.5 * PANEL_M[1]
    corners = pose.apply(np.array([[0, y, z], [0, -y, z], [0, y, -z], [0, -y, -z]]))
    seen = CAMERA.project(corners) + rng.normal(0.0, corner_px, (4, 2))
    axis = pose.rotation[:, 0]
    shape = shape_of_circle(CAMERA, pose.apply([DISTANCE_M, 0, 0]), axis, RADIUS_M)
    assert shape is not None
    points = Ellipse.from_shape(shape).points(ELLIPSE_POINTS)
    ellipse = Ellipse.fit(points + rng.normal(0.0, point_px, points.shape))
    assert ellipse is not None
    true_range = float(axis @ pose.translation_m) / axis[2]
    return RingSight(seen, ellipse, true_range + rng.normal(0.0, range_m), corner_px, range_m)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=61)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--passes", type=int, default=8, help="of each noise level")
    parser.add_argument("--picture", type=Path, help="PNG of the error curves of one pass")
    arguments = parser.parse_args()
    angles = np.radians(np.linspace(-60.0, 60.0, arguments.frames))
    table = Table(title=f"fly-around, seed {arguments.seed}, {arguments.frames} frames a pass")
    for name in ("σ corner, ellipse px, range m", "single R %", "single D_f %", "NEES / 2",
                 "pass R %", "pass D_f %", "NEES / 2 "):  # fmt: skip
        table.add_column(name)
    curves = []
    for number, level in enumerate(LEVELS):
        single, whole, odd, odd_whole, none = [], [], [], [], 0
        for turn in range(arguments.passes):
            rng = np.random.default_rng([arguments.seed, number, turn])
            sights = [sight(pose_at(a), level, rng) for a in angles]
            curve = []
            for one in sights:
                size = ring_size(CAMERA, one)
                if size is None:
                    none += 1
                    curve.append((np.nan, np.nan, np.nan, np.nan))
                    continue
                error = np.array([size.radius_m - RADIUS_M, size.distance_m - DISTANCE_M])
                single.append(error)
                odd.append(error @ np.linalg.solve(size.covariance, error) / 2.0)
                curve.append((*error, *np.sqrt(np.diag(size.covariance))))
            if turn == 0:
                curves.append(np.array(curve))
            size = ring_size_of_pass(CAMERA, sights)
            if size is None:
                raise SystemExit("a pass gave no answer")
            error = np.array([size.radius_m - RADIUS_M, size.distance_m - DISTANCE_M])
            whole.append(error)
            odd_whole.append(error @ np.linalg.solve(size.covariance, error) / 2.0)
        share = 100.0 / np.array([RADIUS_M, DISTANCE_M])
        median = np.median(np.abs(single), axis=0) * share
        high = np.percentile(np.abs(single), 95, axis=0) * share
        worst = np.abs(whole).max(axis=0) * share
        table.add_row(
            f"{level[0]:.2f}, {level[1]:.2f}, {level[2]:.3f}" + (f" ({none} none)" if none else ""),
            f"{median[0]:.3f} / {high[0]:.3f}", f"{median[1]:.3f} / {high[1]:.3f}",
            f"{np.median(odd):.2f} / {np.mean(odd):.2f}",
            f"{worst[0]:.4f}", f"{worst[1]:.4f}", f"{np.mean(odd_whole):.2f}",
        )  # fmt: skip
    console = Console(width=140)
    console.print(table)
    console.print("single frames: median / 95 %; passes: the worst of them")
    if arguments.picture:
        draw(np.degrees(angles), curves, arguments.picture)


def draw(angles_deg: np.ndarray, curves: list[np.ndarray], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.2))
    for level, curve in zip(LEVELS, curves, strict=True):
        for k, (axis, true) in enumerate(zip(axes, (RADIUS_M, DISTANCE_M), strict=True)):
            axis.plot(angles_deg, 100 * curve[:, k] / true, lw=1, label=f"{level[0]:.2f} px")
    for axis, name in zip(axes, ("R", "D_f"), strict=True):
        axis.set(xlabel="degrees off the ring's axis", ylabel=f"error of {name}, %", ylim=(-4, 4))
        axis.grid(alpha=0.3)
    axes[0].legend(title="σ of corners", fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
