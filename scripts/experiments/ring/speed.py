"""Time of the ring detector beside OpenCV's ellipse detectors, on the same frames."""

from __future__ import annotations

import math

import cv2
import numpy as np
from rendezview.simulation.ring_frames import RingSceneOptions, random_scene, render_ring_frame

from experiments.frame import PeerPython, show, table_of
from experiments.peers import opencv_contrib
from rendezview.geometry.camera import Camera
from rendezview.sensors.ring import RingDetector

SIZES = ((640, 480), (1280, 960))


def make_frames(camera: Camera, count: int, seed: int) -> list[np.ndarray]:
    """Frames with a ring of three edges and clutter."""
    scale = camera.width / 640.0
    options = RingSceneOptions(clutter=2, width_px=(150.0 * scale, 380.0 * scale))
    generators = [np.random.default_rng([seed, camera.width, k]) for k in range(count)]
    return [render_ring_frame(random_scene(camera, rng, options), rng) for rng in generators]


def ours(camera: Camera, frames: list[np.ndarray], runs: int) -> tuple[list[float], list[int]]:
    """Least milliseconds of each frame, and its number of ellipses."""
    detector = RingDetector(camera)
    found = [len(detector.detect(frame).edges) for frame in frames]
    return [opencv_contrib.least_ms(lambda f=f: detector.detect(f), runs) for f in frames], found


def floor(frame: np.ndarray) -> list[tuple[object, ...]]:
    """OpenCV's edges, and an ellipse through each that is long enough: nothing is asked of it."""
    edges = cv2.Canny(frame, 50, 100)
    chains = cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    return [cv2.fitEllipseDirect(chain) for chain in chains if len(chain) >= 30]


def run(
    *, seed: int = 81, frames: int = 12, rounds: int = 60, peer_python: PeerPython = None
) -> None:
    """Time of the ring detector beside OpenCV's ellipse detectors, on the same frames.

    Frames with a ring of three edges and clutter. One thread; the least time of repeated runs of
    each frame, then the mean over the frames. The peers run before ours and after. Compare the
    ratios, not the milliseconds.
    """
    cv2.setNumThreads(1)
    title = f"seed {seed}, {frames} frames, least of {rounds} runs each"
    rows = table_of(title, ("size", "detector", "ms a frame", "ours / theirs"), left=4)
    for width, height in SIZES:
        camera = Camera.from_fov(width, height, math.radians(40.0))
        images = make_frames(camera, frames, seed)
        before = opencv_contrib.ellipse_ms(peer_python, images, rounds // 4)
        best, found = ours(camera, images, rounds)
        after = opencv_contrib.ellipse_ms(peer_python, images, rounds // 4)
        mine = float(np.mean(best))
        name = f"rendezview ({np.mean(found):.1f} ellipses)"
        rows.add_row(f"{width} × {height}", name, f"{mine:.2f}", "")
        for name in after:
            theirs = float(np.mean(np.minimum(before[name], after[name])))
            rows.add_row("", name, f"{theirs:.2f}", f"{mine / theirs:.2f}")
    show(rows, width=110)
