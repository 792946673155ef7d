"""Runs of a guidance sensor as scenes, lit and dark, as `rendezview reflectors` reads them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorPattern
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_ground.simulate.reflector_frames import ReflectorFrameOptions, render_pair

CLIENT = Path(__file__).resolve().parents[2] / "models_cad" / "client"
CAMERA = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)


def write_run(
    folder: Path, pattern: ReflectorPattern, poses: Iterable[Pose], *, seed: int = 0,
    step_s: float = 0.5, peaks_grey: Iterable[float] = (),
) -> list[tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """Write ``lit`` and ``dark`` with their truth; their pictures."""
    rng, pairs = np.random.default_rng(seed), []
    options = [ReflectorFrameOptions(peak_grey=peak) for peak in peaks_grey]
    with (
        BopSceneWriter(folder / "lit", CAMERA) as lit_scene,
        BopSceneWriter(folder / "dark", CAMERA) as dark_scene,
    ):
        for k, pose in enumerate(poses):
            chosen = options[k] if options else ReflectorFrameOptions()
            pairs.append(render_pair(CAMERA, pattern, pose, chosen, rng))
            for scene, picture in zip((lit_scene, dark_scene), pairs[-1], strict=True):
                scene.add(k, picture, pose, step_s * k)
    return pairs
