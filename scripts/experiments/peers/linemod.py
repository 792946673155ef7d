"""OpenCV's linemod on frames, for the scripts that time it beside ours.

    python -m experiments recognition-peers frames.npy

Runs in an interpreter with opencv-contrib-python-headless and nothing of this project. Every frame
gives a template of its bright pixels, and the first is then looked for. Prints JSON: the least
milliseconds of a match with one template, and with all.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

ROUNDS = 15


def linemod_ms(python: Path, frames: list[np.ndarray]) -> dict[int, float] | None:
    """Milliseconds of a match by the number of templates; None where that interpreter fails."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.npy"
        np.save(path, np.array(frames))
        command = [str(python), str(Path(__file__)), str(path)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode != 0:
        print(f"absent: linemod: its process ended with {done.returncode}")
        return None
    return {int(templates): ms for templates, ms in json.loads(done.stdout).items()}


def match_ms(frames: list[np.ndarray], templates: int) -> float:
    detector = cv2.linemod.getDefaultLINE()
    for frame in frames[:templates]:
        detector.addTemplate([frame], "target", np.where(frame[..., 0] > 40, 255, 0).astype("u1"))
    spent = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        detector.match([frames[0]], 80.0)
        spent.append(1e3 * (time.perf_counter() - start))
    return min(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    # It asserts or crashes on sides such as 1024 and 1040, not on 960: the target is inside that.
    frames = [
        cv2.cvtColor(np.ascontiguousarray(f[32:-32, 32:-32]), cv2.COLOR_GRAY2BGR)
        for f in np.load(arguments.frames)
    ]
    print(json.dumps({str(n): match_ms(frames, n) for n in (1, len(frames))}))


if __name__ == "__main__":
    main()
