"""Write a simulated run of a video guidance sensor: lit and dark pictures with their truth.

    python -m experiments reflector-run run --readings 60 --from 12 --to 1
    rendezview reflectors run/lit run/dark --target models_cad/client -o readings.jsonl

Two BOP scenes of one camera, the paper's (512 × 384, 652 px a radian). The far target of
models_cad/client is approached; tilt up to --tilt degrees, every roll within ±60°.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from experiments.frame import MODELS_CAD
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import BopSceneWriter
from rendezview.io.target import Target
from rendezview.sensors.reflectors import SixNumbers, patterns_of, pose_of
from rendezview.sensors.reflectors.acquisition import merged
from rendezview.simulation.reflector_frames import (
    ReflectorFrameOptions,
    foil,
    glints,
    render_pair,
)

CAMERA = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)
CLIENT = MODELS_CAD / "client"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path, help="folder of the run")
    parser.add_argument("--readings", type=int, default=60)
    parser.add_argument("--from", dest="start", type=float, default=12.0, help="metres")
    parser.add_argument("--to", dest="end", type=float, default=1.0, help="metres")
    parser.add_argument("--tilt", type=float, default=25.0, help="degrees")
    parser.add_argument("--group", default="far")
    parser.add_argument("--clutter", action="store_true", help="foil and glints")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overwrite", action="store_true")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    patterns = patterns_of(Target.load(CLIENT))
    pattern = next(p for p in patterns if p.name == arguments.group)
    everything = merged(patterns)
    options = ReflectorFrameOptions()
    phase = rng.uniform(0.0, 2.0 * np.pi, 5)
    lit_scene = BopSceneWriter(arguments.output / "lit", CAMERA, overwrite=arguments.overwrite)
    dark_scene = BopSceneWriter(arguments.output / "dark", CAMERA, overwrite=arguments.overwrite)
    with lit_scene as lit_writer, dark_scene as dark_writer:
        for k in range(arguments.readings):
            t = k / max(arguments.readings - 1, 1)
            swing = np.sin(np.array([7.0, 9.0, 5.0, 11.0, 13.0]) * t + phase)
            reach = np.deg2rad(arguments.tilt) / np.sqrt(2.0)
            six = SixNumbers(
                arguments.start * (arguments.end / arguments.start) ** t,
                0.05 * swing[0], 0.04 * swing[1], 1.0 * swing[2], reach * swing[3],
                reach * swing[4],
            )  # fmt: skip
            pose = pose_of(six, pattern)
            clutter = (foil(CAMERA, rng, 25), glints(CAMERA, rng, 4)) if arguments.clutter else ()
            lit, dark = render_pair(CAMERA, everything, pose, options, rng, clutter=clutter)
            lit_writer.add(k, lit, pose, 0.5 * k)
            dark_writer.add(k, dark, pose, 0.5 * k)
    print(f"{arguments.output}: {arguments.readings} readings, seed {arguments.seed}")
