"""OpenCV's two ellipse detectors on frames in a file, for ring-accuracy and ring-speed.

Runs in an interpreter with opencv-contrib-python-headless and nothing of this project. Prints JSON:
the ellipses (x, y, long, short, angle) of every frame by each detector, and with --time the least
and the median milliseconds a frame.
"""

from __future__ import annotations

import argparse
import json
import math
import time

import cv2
import numpy as np


def edge_drawing(image: np.ndarray) -> list[list[float]]:
    drawer = cv2.ximgproc.createEdgeDrawing()
    drawer.detectEdges(image)
    found = drawer.detectEllipses()
    out = []
    for x, y, radius, a, b, angle in np.asarray(found if found is not None else []).reshape(-1, 6):
        out.append(ordered(x, y, radius + a, radius + b, math.radians(angle)))
    return out


def find_ellipses(image: np.ndarray) -> list[list[float]]:
    found = cv2.ximgproc.findEllipses(image, scoreThreshold=0.5, reliabilityThreshold=0.4)
    out = []
    for x, y, a, b, _, angle in np.asarray(found if found is not None else []).reshape(-1, 6):
        out.append(ordered(x, y, a, b, angle))
    return out


def ordered(x: float, y: float, a: float, b: float, angle: float) -> list[float]:
    if b > a:
        a, b, angle = b, a, angle + math.pi / 2
    return [float(x), float(y), float(a), float(b), float(angle)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames")
    parser.add_argument("--time", type=int, default=0, help="rounds")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frames = np.load(arguments.frames)
    detectors = {"EdgeDrawing": edge_drawing, "findEllipses": find_ellipses}
    out: dict[str, object] = {
        "ellipses": {name: [run(f) for f in frames] for name, run in detectors.items()}
    }
    if arguments.time:
        spent: dict[str, list[float]] = {}
        for name, run in detectors.items():
            spent[name] = []
            for frame in frames:
                times = []
                for _ in range(arguments.time):
                    start = time.perf_counter()
                    run(frame)
                    times.append(1e3 * (time.perf_counter() - start))
                spent[name].append(min(times))
        out["ms"] = spent
    print(json.dumps(out))


if __name__ == "__main__":
    main()
