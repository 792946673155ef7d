"""Parts that are mounted aside, and a camera file that is wrong: what calibration makes of them.

The craft is a body with a mast and one wing, which is bent about its hinge.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from rendezview.sensors.appearance.as_built import AsBuilt, ShapeEstimator
from rendezview.simulation.scene import SceneOptions, render_frame
from rendezview.training.job import train
from rendezview.training.mesh import Mesh, load_mesh
from rendezview.training.options import TrainingOptions
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.parts import TrustedPart
from rendezview.sensors.appearance import Recognizer, ViewModel

CAMERA = Camera.from_fov(480, 360, np.deg2rad(40.0))
BODIES = (((2.0, 1.2, 0.8), (0.0, 0.0, 0.0)), ((0.5, 0.5, 0.9), (0.9, 0.3, 0.5)))  # m
WING, HINGE_M = ((1.2, 1.4, 0.05), (0.1, 1.5, 0.0)), (0.1, 0.8, 0.0)
BOX_M = np.array([[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]])
BENT_DEG, FLUTTER_DEG = 6.0, 4.0
RANGE_M = (10.0, 14.0)
FOCAL, CENTRE_PX = 0.97, 6.0  # of the camera file: factor, shift

Frames = list[tuple[Pose, np.ndarray]]


def craft(folder: Path, turn_deg: float) -> Mesh:
    """The craft with its wing turned about the hinge, which is parallel to x."""
    parts = []
    for size_m, place_m in (*BODIES, WING):
        parts.append(trimesh.creation.box(size_m))
        parts[-1].apply_translation(place_m)
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(turn_deg), (1.0, 0.0, 0.0), HINGE_M)
    parts[-1].apply_transform(turn)
    trimesh.util.concatenate(parts).export(folder / "craft.obj")
    return load_mesh(folder / "craft.obj", "m")


def shown(folder: Path, turns_deg: np.ndarray, rng: np.random.Generator) -> Frames:
    """Frames from any side."""
    frames = []
    for turn_deg in turns_deg:
        pose = Pose(
            Rotation.random(random_state=rng).as_matrix(), [0.0, 0.0, rng.uniform(*RANGE_M)]
        )
        sun = np.array([*rng.normal(0.0, 0.2, 2), -1.0])
        light = SceneOptions(sky_frame="camera")
        mesh = craft(folder, float(turn_deg))
        frames.append((pose, render_frame(mesh, CAMERA, pose, sun, light, rng)))
    return frames


def error(model: ViewModel, frames: Frames) -> str:
    """Attitude errors from priors at the truth."""
    recognizer = Recognizer(model, CAMERA)
    poses = [(truth, recognizer.recognize(picture, truth).pose) for truth, picture in frames]
    off = [np.rad2deg(pose.angle_to(truth)) for truth, pose in poses if pose is not None]
    return f"{np.median(off):.3f}° ({len(off)} of {len(frames)})"


def run(*, frames: int = 40, seed: int = 7) -> None:
    """Calibrate on frames of unknown pose, judge on as many others; then a wrong camera file."""
    options = TrainingOptions(
        order=2, perturbed_views=1000, held_out_views=100, shadowed_silhouettes=False
    )
    draws: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
        "as modelled": lambda rng: np.zeros(frames),
        "bent": lambda rng: np.full(frames, BENT_DEG),
        "another angle each frame": lambda rng: rng.uniform(-FLUTTER_DEG, FLUTTER_DEG, frames),
    }
    wing = TrustedPart("wing", 1.0, boxes_m=(BOX_M,))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        train(craft(folder, 0.0), folder / "craft.rvm", name="craft", options=options)
        model = ViewModel.load(folder / "craft.rvm")
        for what, turns in draws.items():
            rng = np.random.default_rng(seed)
            seen, others = (shown(folder, turns(rng), rng) for _ in range(2))

            def found(parts: tuple[TrustedPart, ...], seen: Frames = seen) -> AsBuilt:
                pictures = [picture for _, picture in seen]
                return ShapeEstimator(model, CAMERA).estimate(pictures, parts=parts)

            strain, both = found(()), found((wing,))
            (mounted,) = both.mountings
            print(
                f"{what}: turned {mounted.turn_deg:.2f}°, trust {mounted.trust:.2f}; attitude as "
                f"modelled {error(model, others)}, strain only {error(strain.model, others)}, with "
                f"the part {error(both.model, others)}",
                flush=True,
            )
        told = dataclasses.replace(
            CAMERA, fx=FOCAL * CAMERA.fx, fy=FOCAL * CAMERA.fy, cx=CAMERA.cx + CENTRE_PX
        )
        seen = shown(folder, np.zeros(frames), np.random.default_rng([seed, 1]))
        lens = ShapeEstimator(model, told).estimate([picture for _, picture in seen], lens=True)
        sigma, seen_by = np.sqrt(np.diag(lens.lens_covariance)), lens.camera
        off = 100 * (seen_by.fx / CAMERA.fx - 1)
        print(
            f"camera file {100 * (FOCAL - 1):+.0f} % and {CENTRE_PX:g} px off, {lens.used} frames "
            f"of unknown pose: focal length {off:+.2f} % (σ {100 * sigma[0]:.2f} %), principal "
            f"point {seen_by.cx - CAMERA.cx:+.2f}, {seen_by.cy - CAMERA.cy:+.2f} px (σ "
            f"{sigma[1]:.2f}, {sigma[2]:.2f})"
        )
