"""The README's picture: four frames of a finished demo, side by side.

rendezview demo -o rendezview-demo && python -m experiments readme-picture rendezview-demo
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from experiments.frame import PICTURES

FRAMES = 4
CROP = (slice(50, 410), slice(110, 530))  # the target, without the report's status bar
OUTPUT = PICTURES / "approach.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demo", type=Path, help="folder that the demo wrote")
    arguments = parser.parse_args()
    paths = sorted(arguments.demo.glob("frame_*.png"))
    chosen = [paths[k] for k in np.linspace(0, len(paths) - 1, FRAMES).round().astype(int)]
    strip = np.hstack([cv2.imread(str(path))[CROP] for path in chosen])
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(OUTPUT), strip)
    print(OUTPUT)
