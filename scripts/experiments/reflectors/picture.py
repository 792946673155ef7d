"""The picture of docs/reflectors.md: pair, spots, triplet, windows and pose.

    python -m experiments reflector-picture --seed 6

A simulated pair of the far target at 5 m with crumpled foil and false spots. Left the lit picture,
in the middle the difference with every spot (grey) and the triplet (orange), right the target with
the windows that the reading looked into, and the face frame at the pose.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Rectangle

from experiments.frame import PICTURES
from experiments.reflectors.run import CAMERA, CLIENT
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.reflectors import (
    LitDark,
    ReflectorSensor,
    SixNumbers,
    find_spots,
    patterns_of,
    pose_of,
    predict_spots,
)
from rendezview.simulation.reflector_frames import (
    ReflectorFrameOptions,
    foil,
    glints,
    render_pair,
)

OUTPUT = PICTURES / "reflectors.png"
ORANGE, GREY = "#f0922b", "#9a9a9a"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    six = SixNumbers(5.0, 0.03, 0.02, 0.4, 0.25, -0.2)
    clutter = (foil(CAMERA, rng, 30), glints(CAMERA, rng, 6))
    sensor = ReflectorSensor(CAMERA, [pattern])
    pose = pose_of(six, pattern)
    for k in range(3):  # found, confirmed, followed
        nearer = Pose(pose.rotation, (1.0 - 0.004 * k) * pose.translation_m)
        options = ReflectorFrameOptions()
        frames = LitDark(*render_pair(CAMERA, pattern, nearer, options, rng, clutter=clutter))
        reading = sensor.update(0.5 * k, frames)
    if reading.pose is None or not reading.tracked or frames.dark is None:
        raise SystemExit(f"no pose to draw: {reading.status}, {reading.reason}")
    spots = find_spots(frames)
    three = reading.spots.centroids_px
    figure, axes = plt.subplots(1, 3, figsize=(10.0, 2.9), constrained_layout=True)
    difference = np.clip(frames.lit.astype(int) - frames.dark, 0, 255)
    for panel, image, title in zip(
        axes, (frames.lit, difference, difference),
        (f"lit ({reading.six.range_m:.2f} m)", f"lit − dark: {len(spots)} spots, the triplet",
         "the windows it looked into, and the pose"), strict=True,
    ):  # fmt: skip
        panel.imshow(image, cmap="gray", vmin=0, vmax=200, interpolation="nearest")
        panel.set_title(title, fontsize=9)
        panel.set_xticks([])
        panel.set_yticks([])
    for place, size in zip(spots.centroids_px, spots.size_px, strict=True):
        axes[1].add_patch(Circle(place, 3.0 * size + 5.0, fill=False, color=GREY, lw=0.8))
    axes[1].add_patch(plt.Polygon(three, fill=False, color=ORANGE, lw=0.9))
    windows = zip(sensor._expected[:, :2], sensor._half, strict=True)  # as it looked, no copy
    for (middle, half), place, size, name in zip(
        windows, three, reading.spots.size_px, reading.reflectors, strict=True
    ):
        axes[1].add_patch(Circle(place, 3.0 * size + 5.0, fill=False, color=ORANGE, lw=1.2))
        corner = middle - half
        axes[2].add_patch(Rectangle(corner, 2 * half, 2 * half, fill=False, color=ORANGE, lw=1.2))
        axes[2].annotate(name, corner - (0.0, 2.0), color=ORANGE, fontsize=8)
    tips = np.vstack([np.zeros(3), 0.4 * pattern.base_m * np.eye(3)])
    face = CAMERA.project((reading.pose @ pattern.target_from_face).apply(tips))
    for tip, colour in zip(face[1:], ("#ff5050", "#50dc50", "#50a0ff"), strict=True):
        axes[2].plot(*np.transpose([face[0], tip]), color=colour, lw=1.3)
    shown = predict_spots(CAMERA, pattern, reading.pose)
    middle, reach = shown.mean(axis=0), 0.9 * np.ptp(shown, axis=0).max()
    axes[2].set_xlim(middle[0] - 1.33 * reach, middle[0] + 1.33 * reach)
    axes[2].set_ylim(middle[1] + reach, middle[1] - reach)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output, dpi=90)
    print(arguments.output, f"seed {arguments.seed}")
