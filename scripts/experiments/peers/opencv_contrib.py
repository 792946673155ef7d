"""OpenCV's linemod and ellipse detectors, which only opencv-contrib has.

opencv-contrib cannot be installed beside opencv. `ask` runs this file in another interpreter, with
opencv-contrib-python-headless and nothing of this project, and reads the JSON that it prints.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2  # in the other interpreter with linemod and ximgproc
import numpy as np

ROUNDS = 15  # of a match


def ask(python: Path | None, frames: list[np.ndarray], *words: str) -> Any:
    """The peer's results on the frames; an empty dict where there is no peer, or it fails."""
    if python is None:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.npy"
        np.save(path, np.array(frames))
        command = [str(python), str(Path(__file__)), str(path), *words]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        print(f"absent: {words[0]}: its process ended with {done.returncode}")
        return {}
    return json.loads(done.stdout)


def linemod_ms(python: Path | None, frames: list[np.ndarray]) -> dict[str, float]:
    """Least milliseconds of a match, by the number of templates: one, and one of every frame."""
    return ask(python, frames, "linemod")


def ellipses(python: Path | None, frames: list[np.ndarray]) -> dict[str, list[list[list[float]]]]:
    """Detector to the ellipses (x, y, long, short, angle) of every frame."""
    return ask(python, frames, "ellipses")


def ellipse_ms(python: Path | None, frames: list[np.ndarray], runs: int) -> dict[str, list[float]]:
    """Detector to the least milliseconds of each frame."""
    return ask(python, frames, "time", str(runs))


def match_ms(frames: list[np.ndarray], templates: int) -> float:
    """A template of the bright pixels of each frame, then the first frame is searched."""
    detector = cv2.linemod.getDefaultLINE()  # type: ignore[attr-defined]
    for frame in frames[:templates]:
        detector.addTemplate([frame], "target", np.where(frame[..., 0] > 40, 255, 0).astype("u1"))
    return least_ms(lambda: detector.match([frames[0]], 80.0), ROUNDS)


def edge_drawing(image: np.ndarray) -> list[list[float]]:
    """The ellipses of EdgeDrawing."""
    drawer = cv2.ximgproc.createEdgeDrawing()  # type: ignore[attr-defined]
    drawer.detectEdges(image)
    found = drawer.detectEllipses()
    return [
        ordered(x, y, radius + a, radius + b, math.radians(angle))
        for x, y, radius, a, b, angle in np.asarray([] if found is None else found).reshape(-1, 6)
    ]


def find_ellipses(image: np.ndarray) -> list[list[float]]:
    """The ellipses of findEllipses."""
    found = cv2.ximgproc.findEllipses(image, scoreThreshold=0.5, reliabilityThreshold=0.4)  # type: ignore[attr-defined]
    return [
        ordered(x, y, a, b, angle)
        for x, y, a, b, _, angle in np.asarray([] if found is None else found).reshape(-1, 6)
    ]


def ordered(x: float, y: float, a: float, b: float, angle: float) -> list[float]:
    """With the long axis first."""
    if b > a:
        a, b, angle = b, a, angle + math.pi / 2
    return [float(x), float(y), float(a), float(b), float(angle)]


def least_ms(call: Callable[[], object], runs: int) -> float:
    """Least milliseconds of several runs."""
    spent = []
    for _ in range(runs):
        start = time.perf_counter()
        call()
        spent.append(1e3 * (time.perf_counter() - start))
    return min(spent)


def answer(path: str, what: str, runs: str = "0") -> object:
    """In the other interpreter: one question about the frames of a file."""
    cv2.setNumThreads(1)
    frames = np.load(path)
    if what == "linemod":
        # It asserts or crashes on sides such as 1024 and 1040, not on 960: the target is inside.
        cut = [np.ascontiguousarray(f[32:-32, 32:-32]) for f in frames]
        colour = [cv2.cvtColor(f, cv2.COLOR_GRAY2BGR) for f in cut]
        return {str(n): match_ms(colour, n) for n in (1, len(colour))}
    detectors = {"EdgeDrawing": edge_drawing, "findEllipses": find_ellipses}
    if what == "ellipses":
        return {name: [run(f) for f in frames] for name, run in detectors.items()}
    return {
        name: [least_ms(lambda f=f, run=run: run(f), int(runs)) for f in frames]
        for name, run in detectors.items()
    }


if __name__ == "__main__":
    print(json.dumps(answer(*sys.argv[1:])))
