"""Accuracy and detection of the ring sensor on simulated frames, beside OpenCV's detectors.

    python -m experiments ring-accuracy --seed 71
    python -m experiments ring-accuracy --seed 71 --peer-python /path/to/venv/bin/python

Frames by `simulation/ring_frames.py`, 640 × 480, noise 3 grey levels. The peers (EdgeDrawing's
ellipses and findEllipses of opencv-contrib) run on the same frames in the interpreter given, in a
process of its own (`ring-peers`); where a peer reports several ellipses, the one nearest to a
true edge of the ring counts, which is a help our own detector does not get.

A detection is right when centre and semi-axes are within 2 px, or 3 % of the long axis, of a true
edge of the ring. Every frame counts; a frame without an answer is a miss.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.peers import ellipses
from rendezview.geometry.camera import Camera
from rendezview.sensors.ring import (
    Ellipse,
    RingDetector,
    RingPrior,
    RingSensor,
    circle_poses,
    shape_of_circle,
    tangent_basis,
)
from rendezview.simulation.ring_frames import (
    Circle,
    RingScene,
    RingSceneOptions,
    random_scene,
    render_ring_frame,
)

CAMERA = Camera.from_fov(640, 480, math.radians(40.0))
THIRD = math.radians(120.0)
CASES = {
    "whole ring, tilt 0–60°": RingSceneOptions(),
    "one edge only": RingSceneOptions(edges=(1.0,)),
    "head-on, tilt 0–3°": RingSceneOptions(tilt_rad=(0.0, math.radians(3.0))),
    "120° arc": RingSceneOptions(arc_rad=(THIRD, THIRD)),
    "120° arc, one edge": RingSceneOptions(arc_rad=(THIRD, THIRD), edges=(1.0,)),
    "cut by the border": RingSceneOptions(border=1.0),
}
CLUTTERED = RingSceneOptions(
    clutter=4, border=0.15, arc_rad=(THIRD, 2.5 * math.tau), without_ring=0.1
)


def right(shape: np.ndarray, truth: np.ndarray | None) -> bool:
    """Whether a shape vector is that of a true edge."""
    if truth is None:
        return False
    found, true = Ellipse.from_shape(shape), Ellipse.from_shape(truth)
    allowed = max(2.0, 0.03 * true.semi_axes_px[0])
    return bool(
        np.linalg.norm(found.centre_px - true.centre_px) < allowed
        and np.abs(np.subtract(found.semi_axes_px, true.semi_axes_px)).max() < allowed
    )


def ring_edges(scene: RingScene) -> list[tuple[Circle, np.ndarray]]:
    found = []
    for circle in scene.circles:
        shape = shape_of_circle(scene.camera, circle.centre_m, circle.axis, circle.radius_m)
        if circle.is_ring and shape is not None:
            found.append((circle, shape))
    return found


def frames(options: RingSceneOptions, count: int, seed: list[int]):
    for k in range(count):
        rng = np.random.default_rng([*seed, k])
        scene = random_scene(CAMERA, rng, options)
        yield scene, render_ring_frame(scene, rng)


def errors_of(poses, circle: Circle) -> tuple[float, float] | None:
    """Centre in % of range and axis in degrees of the pose nearer in axis."""
    if not poses:
        return None
    pose = max(poses, key=lambda p: float(p.axis @ circle.axis))
    far = np.linalg.norm(circle.centre_m)
    return (
        100.0 * float(np.linalg.norm(pose.centre_m - circle.centre_m) / far),
        math.degrees(math.acos(min(1.0, float(pose.axis @ circle.axis)))),
    )


def run_peers(python: Path, kept: list[np.ndarray]) -> dict[str, list[list[list[float]]]]:
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "frames.npy", np.array(kept))
        script = Path(ellipses.__file__)
        done = subprocess.run(
            [str(python), str(script), str(Path(folder) / "frames.npy")],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
    return json.loads(done.stdout)["ellipses"]


def accuracy(console: Console, seed: int, count: int, peer: Path | None) -> None:
    table = Table(title=f"accuracy, {count} frames a case, seed {seed}: median / 95 %")
    for name in ("case", "detector", "right", "centre, % of range", "axis, degrees", "NEES / 5",
                 "sign of tilt told / wrong"):  # fmt: skip
        table.add_column(name)
    for number, (case, options) in enumerate(CASES.items()):
        ours: list[tuple[float, float]] = []
        odd: list[float] = []
        told = wrong = 0
        kept, scenes = [], []
        for scene, image in frames(options, count, [seed, number]):
            kept.append(image)
            scenes.append(scene)
            reading = RingSensor(CAMERA, scene.ring.radius_m).update(0.0, image)
            if reading.edge is None:
                continue
            shape = reading.edges[reading.edge].ellipse.shape
            match = next((c for c, t in ring_edges(scene) if right(shape, t)), None)
            if match is None:
                continue
            # Which edge the radius is of is not what is measured here: give the found one's.
            if match.radius_m != scene.ring.radius_m:
                reading = RingSensor(CAMERA, match.radius_m).update(0.0, image)
            found = errors_of(reading.circles, match)
            if found is None:
                continue
            ours.append(found)
            pose = max(reading.circles, key=lambda p: float(p.axis @ match.axis))
            off = np.concatenate(
                [
                    match.centre_m - pose.centre_m,
                    tangent_basis(pose.axis).T @ (match.axis - pose.axis),
                ]
            )
            odd.append(off @ np.linalg.solve(pose.covariance, off) / 5.0)
            if reading.circle is not None and len(reading.circles) == 2:
                told += 1
                wrong += float(reading.circle.axis @ match.axis) < float(pose.axis @ match.axis) - (
                    1e-6 + np.trace(pose.covariance[3:, 3:])
                )
        rows = {"rendezview": (ours, f"{np.median(odd):.2f} / {np.mean(odd):.2f}",
                               f"{told} / {wrong}")}  # fmt: skip
        if peer is not None:
            for name, found_by in run_peers(peer, kept).items():
                theirs = []
                for scene, ellipses in zip(scenes, found_by, strict=True):
                    best = nearest(scene, ellipses)
                    if best is not None:
                        theirs.append(best)
                rows[name] = (theirs, "", "")
        for name, (values, consistent, sign) in rows.items():
            line = [f"{len(values)} of {count}", "–", "–"]
            if values:
                centre, axis = np.percentile(values, [50, 95], axis=0).T
                line[1:] = [f"{centre[0]:.4f} / {centre[1]:.4f}", f"{axis[0]:.3f} / {axis[1]:.3f}"]
            table.add_row(case if name == "rendezview" else "", name, *line, consistent, sign)
    console.print(table)


def nearest(scene: RingScene, ellipses: list[list[float]]) -> tuple[float, float] | None:
    """Errors of the ellipse (x, y, long, short, angle) nearest to a true edge, if one is right."""
    best, error = None, math.inf
    for x, y, long, short, angle in ellipses:
        if not short > 1.0:
            continue
        found = Ellipse(np.array([x, y]), (long, short), angle)
        for circle, truth in ring_edges(scene):
            off = float(np.abs(found.shape - truth).max())
            if off < error and right(found.shape, truth):
                poses = circle_poses(CAMERA, found, circle.radius_m)
                if poses:
                    best, error = errors_of(poses, circle), off
    return best


def detection(
    console: Console, seed: int, count: int, least_score: float, peer: Path | None
) -> None:
    table = Table(title=f"detection, {count} cluttered frames, seed {seed}")
    for name in ("detector and rule", "answers", "right", "precision", "recall"):
        table.add_column(name)
    detector = RingDetector(CAMERA)
    rings = 0
    best, several = "rendezview, best score", "rendezview, best score, several concentric edges"
    known = "rendezview, known radius and range to 5 %"
    counts = {best: [0, 0], several: [0, 0], known: [0, 0]}
    among = [0, 0]
    reach = 0
    kept, scenes = [], []
    for scene, image in frames(CLUTTERED, count, [seed, 99]):
        kept.append(image)
        scenes.append(scene)
        rng = np.random.default_rng([seed, 98, len(scenes)])
        edges = ring_edges(scene)
        rings += bool(edges)
        found = detector.detect(image).edges
        circles = [shape_of_circle(CAMERA, c.centre_m, c.axis, c.radius_m) for c in scene.circles]
        among[0] += len(found)
        among[1] += sum(any(right(e.ellipse.shape, t) for t in circles) for e in found)
        reach += any(right(e.ellipse.shape, t) for e in found for _, t in edges)
        if found and found[0].score >= least_score:
            good = any(right(found[0].ellipse.shape, t) for _, t in edges)
            counts[best][0] += 1
            counts[best][1] += good
            if sum(edge.family == found[0].family for edge in found) > 1:
                counts[several][0] += 1
                counts[several][1] += good
        if scene.ring is not None:
            ring = scene.ring
            range_m = float(np.linalg.norm(ring.centre_m)) * (1.0 + rng.normal(0.0, 0.05))
            radius = ring.radius_m
        else:  # as the last scene's: there is nothing to find
            range_m, radius = 6.0, 0.6
        reading = RingSensor(CAMERA, radius).update(0.0, image, RingPrior(range_m=range_m))
        if reading.edge is not None and reading.edges[reading.edge].score >= least_score:
            counts[known][0] += 1
            counts[known][1] += any(
                right(reading.edges[reading.edge].ellipse.shape, t) for _, t in edges
            )
    for name, (answers, good) in counts.items():
        table.add_row(name, str(answers), str(good), f"{good / max(answers, 1):.3f}",
                      f"{good / rings:.3f}")  # fmt: skip
    table.add_row("rendezview, any ellipse of any true circle", str(among[0]), str(among[1]),
                  f"{among[1] / max(among[0], 1):.3f}", "")  # fmt: skip
    table.add_row("rendezview, the ring among the ellipses", "", str(reach), "",
                  f"{reach / rings:.3f}")  # fmt: skip
    if peer is not None:
        for name, found_by in run_peers(peer, kept).items():
            answers = sum(bool(ellipses) for ellipses in found_by)
            good = sum(
                nearest(scene, ellipses) is not None
                for scene, ellipses in zip(scenes, found_by, strict=True)
            )
            table.add_row(f"{name}, the ring among the ellipses", str(answers), str(good), "",
                          f"{good / rings:.3f}")  # fmt: skip
    console.print(table)
    console.print(f"{rings} of {count} frames have a ring")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=71)
    parser.add_argument("--frames", type=int, default=150, help="of each case")
    parser.add_argument("--cluttered", type=int, default=1000)
    parser.add_argument("--least-score", type=float, default=0.15, help="of an answer")
    parser.add_argument("--peer-python", type=Path, help="an interpreter with opencv-contrib")
    arguments = parser.parse_args()
    console = Console(width=150)
    if arguments.frames:
        accuracy(console, arguments.seed, arguments.frames, arguments.peer_python)
    if arguments.cluttered:
        least = arguments.least_score
        detection(console, arguments.seed, arguments.cluttered, least, arguments.peer_python)
