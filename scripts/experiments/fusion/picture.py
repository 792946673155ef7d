"""The picture of docs/fusion.md: errors of sensors and filter over the range, and its σ.

python -m experiments fusion-approach RUNS --seeds 50 --json samples.json
python -m experiments fusion-picture samples.json
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from experiments.frame import PICTURES

OUTPUT = PICTURES / "fusion.png"
EDGES_M = np.geomspace(0.99, 60.1, 25)
COLOURS = {"fused": "#222222", "appearance": "#d9731a", "ring": "#2b7bba", "laser": "#4a9a4a"}


def curve(range_m: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each bin and median error, where at least ten frames are."""
    middles, medians = [], []
    for near, far in pairwise(EDGES_M):
        inside = error[(range_m >= near) & (range_m < far)]
        inside = inside[np.isfinite(inside)]
        if len(inside) >= 10:
            middles.append(np.sqrt(near * far))
            medians.append(np.median(inside))
    return np.array(middles), np.array(medians)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("samples", type=Path)
    arguments = parser.parse_args()
    rows = json.loads(arguments.samples.read_text())
    range_m = np.array([row["range_m"] for row in rows])
    figure, axes = plt.subplots(1, 2, figsize=(10.0, 3.8), constrained_layout=True)
    panels = ((0, 1e3, "ring's centre, mm"), (2, 180.0 / np.pi, "ring's axis, °"))
    for panel, (k, scale, label) in zip(axes, panels, strict=True):
        for name in ("appearance", "ring", "laser"):
            index = 1 if name == "laser" and k == 0 else k  # a ranger knows the depth only
            error = np.array([row["single"].get(name, [np.nan] * 4)[index] for row in rows])
            x, y = curve(range_m, scale * error)
            if len(x):
                panel.plot(x, y, color=COLOURS[name], lw=1.4, label=name)
        x, y = curve(range_m, scale * np.array([row["fused"][k] for row in rows]))
        panel.plot(x, y, color=COLOURS["fused"], lw=2.2, label="fused")
        panel.set(xscale="log", yscale="log", xlabel="camera to ring, m", ylabel=label)
        panel.invert_xaxis()
        panel.grid(True, which="major", alpha=0.3)
    axes[0].legend(frameon=False)
    figure.savefig(OUTPUT, dpi=110)
    print(OUTPUT)
