"""OpenCV's ellipse detectors, which only opencv-contrib has.

opencv-contrib cannot be installed beside opencv. `ellipses` runs this file in another interpreter,
with opencv-contrib-python-headless and nothing of this project, and reads the JSON that it prints.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2  # in the other interpreter with ximgproc
import numpy as np

Ellipses = list[list[float]]  # x, y, long, short, angle of each


def ellipses(python: Path | None, frames: list[np.ndarray]) -> dict[str, list[Ellipses]]:
    """Detector to the ellipses of every frame; empty where there is no peer, or it fails."""
    if python is None:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.npy"
        np.save(path, np.array(frames))
        command = [str(python), str(Path(__file__)), str(path)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        print(f"absent: ellipses: its process ended with {done.returncode}")
        return {}
    return json.loads(done.stdout)


def edge_drawing(image: np.ndarray) -> Ellipses:
    """Of EdgeDrawing."""
    drawer = cv2.ximgproc.createEdgeDrawing()  # type: ignore[attr-defined]
    drawer.detectEdges(image)
    found = np.asarray([] if (them := drawer.detectEllipses()) is None else them).reshape(-1, 6)
    return [
        ordered(x, y, radius + a, radius + b, math.radians(angle))
        for x, y, radius, a, b, angle in found
    ]


def find_ellipses(image: np.ndarray) -> Ellipses:
    """Of findEllipses."""
    found = cv2.ximgproc.findEllipses(image, scoreThreshold=0.5, reliabilityThreshold=0.4)  # type: ignore[attr-defined]
    each = np.asarray([] if found is None else found).reshape(-1, 6)
    return [ordered(x, y, a, b, angle) for x, y, a, b, _, angle in each]


def ordered(x: float, y: float, a: float, b: float, angle: float) -> list[float]:
    """With the long axis first."""
    if b > a:
        a, b, angle = b, a, angle + math.pi / 2
    return [float(x), float(y), float(a), float(b), float(angle)]


if __name__ == "__main__":
    cv2.setNumThreads(1)
    detectors = {"EdgeDrawing": edge_drawing, "findEllipses": find_ellipses}
    shown = np.load(sys.argv[1])
    print(json.dumps({name: [run(f) for f in shown] for name, run in detectors.items()}))
