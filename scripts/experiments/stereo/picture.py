"""The picture of docs/stereo.md: figure 8 of Welch et al. (1991), one run of 2° steps.

    python -m experiments stereo-picture --seed 11

What is read less the line through it, over the stage's angle, reading by reading: the paper's
solver on single and on averaged scans of photodiodes, ours, and two picture cameras. The figures
are those of ``stereo-accuracy --part figure8``, which has many runs.
"""

from __future__ import annotations

import argparse

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from experiments.frame import PICTURES
from experiments.stereo.accuracy import (
    AVERAGED,
    POSITIONS,
    by_paper,
    by_pictures,
    by_tracker,
    leds_of,
    turned_deg,
)
from rendezview.io.target import Target
from rendezview.sensors.stereo import MotionOptions, Normalisation
from rendezview.sensors.stereo.laboratory import calibrate_laboratory
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions
from rendezview.simulation.led_pictures import PictureOptions, picture_rig

OUTPUT = PICTURES / "stereo.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--target", default="models_cad/scole")
    parser.add_argument("--seed", type=int, default=11)
    arguments = parser.parse_args()
    target = Target.load(arguments.target)
    laboratory = Laboratory(leds_of(target), LaboratoryOptions(), arguments.seed)
    rng = np.random.default_rng(arguments.seed)
    record = laboratory.calibration(rng)
    rig = calibrate_laboratory(record).rig
    plain = calibrate_laboratory(record, Normalisation.PAIR, order=3).rig
    angles = 2.0 * (np.arange(POSITIONS) - POSITIONS // 2)
    poses = laboratory.stage(np.deg2rad(angles))
    single = laboratory.currents(poses, rng)
    noise = laboratory.noise / np.sqrt(AVERAGED)
    mean = laboratory.currents(poses, None) + rng.normal(0.0, noise, single.shape)
    options = PictureOptions(signal_to_noise=200.0)
    cameras = picture_rig(laboratory, options)
    panels = {
        "photodiodes, one scan a reading": {
            "the paper's solver": by_paper(plain, target, single, poses[0]),
            "ours": turned_deg(by_tracker(rig, target, single, None)),
            "ours, filter": turned_deg(by_tracker(rig, target, single, MotionOptions())),
        },
        f"the mean of {AVERAGED} scans, and single pictures": {
            "the paper's solver": by_paper(plain, target, mean, poses[0]),
            "ours": turned_deg(by_tracker(rig, target, mean, None)),
            "ours, two picture cameras, no mean": turned_deg(
                by_pictures(cameras, target, poses, options, rng)
            ),
        },
    }
    colours = ("#d9731a", "#2b7bba", "#222222")
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.0), layout="constrained")
    for axis, (title, lines) in zip(axes, panels.items(), strict=True):
        for colour, (name, read) in zip(colours, lines.items(), strict=True):
            left = read - np.polyval(np.polyfit(angles, read, 1), angles)
            axis.plot(angles, left, ".-", color=colour, lw=0.8, ms=4, label=name)
        axis.set(title=title, xlabel="stage, °")
        axis.set_ylabel("read less its line, °")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(OUTPUT, dpi=110)
    print(OUTPUT)
