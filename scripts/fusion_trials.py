"""Approaches to the client's ring through the real pipeline, kept as files; see fusion_approach.py.

A folder holds one run: ``scene/`` (BOP frames with truth), ``truth.jsonl`` (camera_from_target
every half second), and a log of each sensor as the commands write it: ``appearance.jsonl``
(`rendezview track --log`), ``ring.jsonl`` (`rendezview ring -o`), ``laser.jsonl``.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.appearance import Status, ViewModel
from rendezview.appearance.following import follow, record
from rendezview.camera import Camera
from rendezview.pose import Pose
from rendezview.results import JsonLinesWriter
from rendezview.sequences import BopSceneWriter, Frame, Sequence, open_sequence
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.approach import ApproachOptions, approach, echo
from rendezview.simulation.shading import ShadingOptions
from rendezview.target import Target
from rendezview.training.mesh import load_mesh

CLIENT = Path(__file__).resolve().parents[1] / "models_cad" / "client"
CAMERA = Camera(1024, 1024, 800.0, 800.0, 511.5, 511.5)
FRAME_EVERY = 4  # of the true poses: 2 s
LASER_SIGMA_M = 0.02
LASER_ORIGIN_M = (0.3, 0.0, 0.0)  # beside the camera, along its boresight
SUN_PHASE_DEG = (10.0, 40.0)
PRIOR_ERROR_DEG = 8.0  # of the attitude that the recognizer is given at the start
SILENT_FRAMES = 5  # without a pose, where the body overflows: then the recognizer is switched off


def render_run(folder: Path, seed: int) -> None:
    """The frames, the truth and the ranger's echoes of one seed, unless they are there."""
    if (folder / "truth.jsonl").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    target = Target.load(CLIENT)
    assert target.docking_ring is not None
    mesh = load_mesh(target.mesh_path, target.unit)
    rng = np.random.default_rng([5, seed])
    poses = approach(target.docking_ring, ApproachOptions(), rng)
    phase = math.radians(rng.uniform(*SUN_PHASE_DEG))
    first = poses[0][1]
    sun = sun_at_phase(first.apply(mesh.bounding_sphere[0]), phase, rng.uniform(0.0, 2 * math.pi))
    sun_target = first.rotation.T @ sun
    options = SceneOptions(shading=ShadingOptions(samples=2))
    with JsonLinesWriter(folder / "laser.jsonl") as writer:
        for time_s, pose in poses:
            distance = echo(mesh, pose, LASER_ORIGIN_M, (0.0, 0.0, 1.0))
            noise = LASER_SIGMA_M * rng.standard_normal()
            writer.write(
                {
                    "time_s": time_s,
                    "range_m": None if distance is None else distance + noise,
                    "sigma_m": LASER_SIGMA_M,
                    "origin_m": LASER_ORIGIN_M,
                    "direction": (0.0, 0.0, 1.0),
                }
            )
    with BopSceneWriter(folder / "scene", CAMERA, overwrite=True) as scene:
        for k, (time_s, pose) in enumerate(poses[::FRAME_EVERY]):
            image = render_frame(mesh, CAMERA, pose, pose.rotation @ sun_target, options, rng)
            scene.add(k, image, pose, time_s)
    with JsonLinesWriter(folder / "truth.jsonl") as writer:
        for time_s, pose in poses:
            writer.write({"time_s": time_s, "pose": pose})


def track_run(folder: Path, seed: int, model: ViewModel) -> None:
    """The recognizer's log, as `rendezview track --log` writes it."""
    if (folder / "appearance.jsonl").exists():
        return
    sequence = open_sequence(folder / "scene")
    truth = sequence.frames[0].camera_from_target
    assert truth is not None
    rng = np.random.default_rng([6, seed])
    tilt = rng.standard_normal(3)
    tilt *= math.radians(PRIOR_ERROR_DEG) / np.linalg.norm(tilt)
    prior = Pose(Rotation.from_rotvec(tilt).as_matrix() @ truth.rotation, truth.translation_m)
    with JsonLinesWriter(folder / "appearance.jsonl") as writer:
        silent = 0
        for frame, sighting in follow(model, sequence, prior=prior):
            writer.write(record(frame, sighting))
            silent = 0 if sighting.status is Status.OK else silent + 1
            if silent >= SILENT_FRAMES and _overflows(frame, model):
                break


def _overflows(frame: Frame, model: ViewModel) -> bool:
    truth = frame.camera_from_target
    if truth is None:
        return False
    half = 0.5 * CAMERA.width / CAMERA.fx
    return bool(model.target_radius_m / truth.apply(model.centre_m)[2] > half)


def scene_of(folder: Path) -> Sequence:
    """The frames of a run."""
    return open_sequence(folder / "scene")
