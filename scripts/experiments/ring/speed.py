"""Time of the ring detector beside OpenCV's ellipse detectors, on the same frames in the same run.

    python -m experiments ring-speed --seed 81 --peer-python /path/to/venv/bin/python

Simulated frames with a ring of three edges and clutter, 640 × 480 and 1280 × 960. One thread; the
least time of repeated runs of each frame, so that other work on the machine counts little; then the
mean over frames. The peers run in the interpreter given, one round before ours and one after.
Compare the ratios, not the milliseconds.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.peers import ellipses
from rendezview.geometry.camera import Camera
from rendezview.sensors.ring import RingDetector
from rendezview.simulation.ring_frames import RingSceneOptions, random_scene, render_ring_frame

SIZES = ((640, 480), (1280, 960))


def make_frames(camera: Camera, count: int, seed: int) -> list[np.ndarray]:
    scale = camera.width / 640.0
    options = RingSceneOptions(clutter=2, width_px=(150.0 * scale, 380.0 * scale))
    out = []
    for k in range(count):
        rng = np.random.default_rng([seed, camera.width, k])
        out.append(render_ring_frame(random_scene(camera, rng, options), rng))
    return out


def ours(camera: Camera, frames: list[np.ndarray], rounds: int) -> tuple[list[float], list[int]]:
    detector = RingDetector(camera)
    best, found = [], []
    for frame in frames:
        times = []
        for _ in range(rounds):
            start = time.perf_counter()
            detection = detector.detect(frame)
            times.append(1e3 * (time.perf_counter() - start))
        best.append(min(times))
        found.append(len(detection.edges))
    return best, found


def floor(frame: np.ndarray) -> list[tuple[object, ...]]:
    """OpenCV's edges, and an ellipse through each that is long enough: nothing is asked of it."""
    edges = cv2.Canny(frame, 50, 100)
    chains = cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    return [cv2.fitEllipseDirect(chain) for chain in chains if len(chain) >= 30]


def peers(python: Path, frames: list[np.ndarray], rounds: int) -> dict[str, list[float]]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.npy"
        np.save(path, np.array(frames))
        script = Path(ellipses.__file__)
        done = subprocess.run(
            [str(python), str(script), str(path), "--time", str(rounds)],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
    return json.loads(done.stdout)["ms"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=81)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--peer-python", type=Path, help="an interpreter with opencv-contrib")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    table = Table(title=f"seed {arguments.seed}, {arguments.frames} frames, least of "
                  f"{arguments.rounds} runs each")  # fmt: skip
    for name in ("size", "detector", "ms a frame", "ours / theirs"):
        table.add_column(name)
    for width, height in SIZES:
        camera = Camera.from_fov(width, height, math.radians(40.0))
        frames = make_frames(camera, arguments.frames, arguments.seed)
        theirs: dict[str, list[float]] = {}
        if arguments.peer_python:
            theirs = peers(arguments.peer_python, frames, arguments.rounds // 4)
        best, found = ours(camera, frames, arguments.rounds)
        if arguments.peer_python:
            again = peers(arguments.peer_python, frames, arguments.rounds // 4)
            theirs = {name: list(np.minimum(theirs[name], again[name])) for name in theirs}
        mine = float(np.mean(best))
        table.add_row(f"{width} × {height}", f"rendezview ({np.mean(found):.1f} ellipses)",
                      f"{mine:.2f}", "")  # fmt: skip
        for name, values in theirs.items():
            table.add_row("", name, f"{np.mean(values):.2f}", f"{mine / np.mean(values):.2f}")
    Console(width=110).print(table)
