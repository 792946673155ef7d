"""Write a simulated run of a video guidance sensor: lit and dark pictures with their truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.sensors.reflectors import SixNumbers, patterns_of, pose_of
from rendezview.sensors.reflectors.acquisition import merged
from rendezview.simulation.reflector_frames import ReflectorFrameOptions, foil, glints, render_pair

from experiments.frame import MODELS_CAD
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import BopSceneWriter
from rendezview.io.target import Target

CAMERA = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)
CLIENT = MODELS_CAD / "client"


def run(
    output: Annotated[Path, "folder of the run"], *, readings: int = 60,
    from_: Annotated[float, "metres"] = 12.0, to: Annotated[float, "metres"] = 1.0,
    tilt: Annotated[float, "degrees"] = 25.0, group: str = "far",
    clutter: Annotated[bool, "foil and glints"] = False, seed: int = 0, overwrite: bool = False,
) -> None:  # fmt: skip
    """Write a simulated run of a video guidance sensor: lit and dark pictures with their truth.

        rendezview reflectors run/lit run/dark --target client -o readings.jsonl

    Two BOP scenes of one camera, the paper's (512 × 384, 652 px a radian). The far target of
    models_cad/client is approached; tilt up to --tilt degrees, every roll within ±60°.
    """
    rng = np.random.default_rng(seed)
    patterns = patterns_of(Target.load(CLIENT))
    pattern = next(p for p in patterns if p.name == group)
    everything = merged(patterns)
    options = ReflectorFrameOptions()
    phase = rng.uniform(0.0, 2.0 * np.pi, 5)
    lit_scene = BopSceneWriter(output / "lit", CAMERA, overwrite=overwrite)
    dark_scene = BopSceneWriter(output / "dark", CAMERA, overwrite=overwrite)
    with lit_scene as lit_writer, dark_scene as dark_writer:
        for k in range(readings):
            t = k / max(readings - 1, 1)
            swing = np.sin(np.array([7.0, 9.0, 5.0, 11.0, 13.0]) * t + phase)
            reach = np.deg2rad(tilt) / np.sqrt(2.0)
            six = SixNumbers(
                from_ * (to / from_) ** t,
                0.05 * swing[0], 0.04 * swing[1], 1.0 * swing[2], reach * swing[3],
                reach * swing[4],
            )  # fmt: skip
            pose = pose_of(six, pattern)
            lights = (foil(CAMERA, rng, 25), glints(CAMERA, rng, 4)) if clutter else ()
            lit, dark = render_pair(CAMERA, everything, pose, options, rng, clutter=lights)
            lit_writer.add(k, lit, pose, 0.5 * k)
            dark_writer.add(k, dark, pose, 0.5 * k)
    print(f"{output}: {readings} readings, seed {seed}")
