"""Sequences, frames without a target, and an inexact model: docs/refinement.md."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from rendezview.simulation import (
    Earth,
    SceneOptions,
    ShadingOptions,
    Stars,
    render_frame,
    sun_at_phase,
)
from rendezview.simulation.command import default_camera
from rendezview.training.job import train
from rendezview.training.mesh import Mesh
from rendezview.training.open_executor import open_executor
from rendezview.training.options import TrainingOptions
from scipy.spatial.transform import Rotation

from experiments.frame import Dask, mesh_of
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel

WRONG_DEG = 5.0
FRAMES = 125  # of a sequence
KINDS = ("nothing", "another target", "Earth", "stars", "glint", "half out")


def error_deg(pose: Pose, truth: Pose, model: ViewModel) -> float:
    return float(np.rad2deg(angle_between(pose, truth, model.symmetries)))


def sequence(
    models: Path, target: str, kind: str, seed: int
) -> tuple[int, int, list[float], list[float]]:
    """Frames, losses, rotation errors in degrees and translation errors in shares of range."""
    name, mesh = mesh_of(target)
    model = ViewModel.load(models / f"{name}.rvm")
    camera = default_camera()
    rng = np.random.default_rng([seed, 1 if kind == "approach" else 2])
    centre_m, radius_m = mesh.bounding_sphere
    rotation = Rotation.random(random_state=rng)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    sun_azimuth = rng.uniform(0.0, 2.0 * math.pi)
    step = np.deg2rad(rng.uniform(1.0, 5.0))
    tracker: Tracker | None = None
    losses, errors, shares = 0, [], []
    for k in range(FRAMES):
        along = k / (FRAMES - 1)
        if kind == "approach":
            depth, turn = radius_m * (6.4 - 3.2 * along), 0.3 * step
        else:
            depth, turn = radius_m * 4.5, step
        rotation = Rotation.from_rotvec(turn * axis) * rotation
        aside = 0.06 * depth * np.array([math.sin(0.1 * k), math.cos(0.07 * k)])
        pose = Pose(rotation.as_matrix(), [aside[0], aside[1], depth] - rotation.apply(centre_m))
        phase = np.deg2rad(15.0 + 15.0 * math.sin(0.05 * k))
        sun = sun_at_phase(pose.apply(centre_m), phase, sun_azimuth)
        options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=4))
        frame = render_frame(mesh, camera, pose, sun, options, rng)
        if tracker is None:
            tracker = Tracker(Recognizer(model, camera), prior=pose)
        observation = tracker.update(float(k), frame)
        if observation.pose is None or error_deg(observation.pose, pose, model) > WRONG_DEG:
            losses += 1
            continue
        errors.append(error_deg(observation.pose, pose, model))
        centre = pose.apply(centre_m)
        shares.append(float(np.linalg.norm(observation.pose.apply(centre_m) - centre) / depth))
    return FRAMES, losses, errors, shares


def other_frame(
    kind: str, mesh: Mesh, other: Mesh, camera: Camera, rng: np.random.Generator
) -> tuple[Array, Pose | None]:
    """A frame on which no pose, or hardly any, can be claimed; the truth of a half target."""
    centre_m, radius_m = mesh.bounding_sphere
    rotation = Rotation.random(random_state=rng).as_matrix()
    depth = radius_m * rng.uniform(3.0, 6.0)
    away = Pose(rotation, np.array([50.0 * depth, 0.0, depth]))
    sun = sun_at_phase([0.0, 0.0, 1.0], np.deg2rad(rng.uniform(0.0, 60.0)), rng.uniform(0.0, 6.28))
    options = SceneOptions(sky_frame="camera")
    options = dataclasses.replace(
        options, sensor=dataclasses.replace(options.sensor, exposure=rng.uniform(100.0, 400.0))
    )
    if kind == "another target":
        centre, radius = other.bounding_sphere
        depth = radius * rng.uniform(3.0, 6.0)
        pose = Pose(rotation, np.array([0.0, 0.0, depth]) - rotation @ centre)
        automatic = SceneOptions(sky_frame="camera")
        return render_frame(other, camera, pose, sun, automatic, rng), None
    if kind == "half out":
        aside = camera.width / 2.0 / camera.fx * depth * rng.choice([-1.0, 1.0])
        pose = Pose(rotation, np.array([aside, 0.0, depth]) - rotation @ centre_m)
        return render_frame(mesh, camera, pose, sun, SceneOptions(sky_frame="camera"), rng), pose
    if kind == "Earth":
        off = rng.uniform(0.0, 1.4)
        below = (math.sin(off), 0.3 * math.sin(off), math.cos(off))
        options = dataclasses.replace(
            options, earth=Earth(seed=int(rng.integers(2**31))), earth_direction_sky=below
        )
    elif kind == "stars":
        options = dataclasses.replace(options, stars=Stars(seed=int(rng.integers(2**31))))
    frame = render_frame(mesh, camera, away, sun, options, rng)
    if kind == "glint":
        x, y = rng.uniform(80, camera.width - 80), rng.uniform(80, camera.height - 80)
        v, u = np.mgrid[: camera.height, : camera.width]
        spread = rng.uniform(3.0, 25.0)
        distance = np.hypot(u - x, v - y)
        streak = np.exp(-np.abs(v - y) / 2.0) * np.exp(-np.abs(u - x) / (6.0 * spread))
        bright = 400.0 * np.exp(-distance / spread) + 250.0 * streak
        frame = np.clip(frame + bright, 0, 255).astype(np.uint8)
    return frame, None


def refusals(
    models: Path, target: str, other: str, kind: str, count: int, seed: int
) -> tuple[int, int]:
    """Poses given, and those of them that are wrong."""
    name, mesh = mesh_of(target)
    _, another = mesh_of(other)
    camera = default_camera()
    model = ViewModel.load(models / f"{name}.rvm")
    recognizer = Recognizer(model, camera)
    given = wrong = 0
    for k in range(count):
        rng = np.random.default_rng([seed, KINDS.index(kind), k])
        frame, truth = other_frame(kind, mesh, another, camera, rng)
        observation = recognizer.recognize(frame)
        if observation.pose is None:
            continue
        given += 1
        wrong += truth is None or error_deg(observation.pose, truth, model) > WRONG_DEG
    return given, wrong


def inexact(path: str, seed: int) -> None:
    """A mesh stretched by 4 % along x as the model of itself."""
    name, mesh = mesh_of(path)
    stretched = dataclasses.replace(mesh, vertices_m=mesh.vertices_m * np.array([1.04, 1.0, 1.0]))
    camera = default_camera()
    with tempfile.TemporaryDirectory() as folder:
        for what, made, shape_error in (
            ("exact", mesh, 0.0),
            ("4 % longer", stretched, 0.0),
            ("4 % longer, shape_error = 0.04", stretched, 0.04),
        ):
            model_path = Path(folder) / "model.rvm"
            # The trees do not matter here: poses are refined from near the truth.
            options = TrainingOptions(
                perturbed_views=1000, held_out_views=100, shadowed_silhouettes=False
            )
            train(made, model_path, name=name, options=options, shape_error=shape_error)
            model = ViewModel.load(model_path)
            recognizer = Recognizer(model, camera)
            errors, shares, nees, given = [], [], [], 0
            for k in range(100):
                rng = np.random.default_rng([seed, k])
                centre_m, radius_m = mesh.bounding_sphere
                rotation = Rotation.random(random_state=rng).as_matrix()
                depth = radius_m * rng.uniform(3.0, 6.0)
                pose = Pose(rotation, np.array([0.0, 0.0, depth]) - rotation @ centre_m)
                azimuth = rng.uniform(0.0, 6.28)
                sun = sun_at_phase([0.0, 0.0, 1.0], np.deg2rad(rng.uniform(0.0, 30.0)), azimuth)
                scene = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=4))
                frame = render_frame(mesh, camera, pose, sun, scene, rng)
                start = Rotation.from_rotvec(rng.normal(size=3) * 0.03).as_matrix() @ rotation
                prior = Pose(start, np.array([0.0, 0.0, depth]) - start @ centre_m)
                observation = recognizer.recognize(frame, prior, np.deg2rad(6.0))
                if observation.pose is None or observation.covariance is None:
                    continue
                given += 1
                turn = Rotation.from_matrix(rotation @ observation.pose.rotation.T).as_rotvec()
                error = np.concatenate([turn, pose.translation_m - observation.pose.translation_m])
                errors.append(np.rad2deg(np.linalg.norm(turn)))
                shares.append(np.linalg.norm(error[3:]) / depth)
                nees.append(error @ np.linalg.solve(observation.covariance, error))
            print(
                f"{name}, model {what}: given {given} of 100, rotation "
                f"{np.median(errors):.3f}° median, {np.percentile(errors, 95):.2f}° 95 %, "
                f"translation {100 * np.median(shares):.2f} % of range, "
                f"NEES median {np.median(nees):.1f}, mean {np.mean(nees):.1f}"
            )


def run(
    part: Literal["sequences", "refusals", "inexact"],
    models: Annotated[str, "folder of models; the mesh for inexact"],
    targets: list[str] = [],  # noqa: B006
    *, seed: int = 77, count: Annotated[int, "refusals: frames a kind and target"] = 42,
    dask: Dask = None,
) -> None:  # fmt: skip
    """Sequences, frames without a target, and an inexact model.

    sequences: approach and fly-around, 1–5° a frame, Sun phase 0–30°, our own simulator; a loss is
    a frame without a pose or more than 5° off. refusals: frames with no target, another target,
    the Earth and its limb, stars, a glint, and half the target out of the frame; counted are the
    poses given, and of the last kind those more than 5° off. inexact: a model trained on a mesh
    4 % longer along one axis, tried on frames of the mesh itself.
    """
    if part == "inexact":
        inexact(models, seed)
        return
    if not targets:
        raise SystemExit("name the targets whose models are in the folder")
    one = sequence if part == "sequences" else refusals
    tasks: list[tuple[str, ...]]
    if part == "sequences":
        tasks = [(target, kind) for target in targets for kind in ("approach", "fly-around")]
        shards = [(*task, seed) for task in tasks]
    else:
        others = [*targets[1:], targets[0]]
        tasks = [(*pair, kind) for pair in zip(targets, others, strict=True) for kind in KINDS]
        shards = [(*task, count, seed) for task in tasks]
    with open_executor(2, dask, processes=True) as workers:
        results = dict(workers.results(one, (Path(models).resolve(),), shards))
    done = [(tasks[k], results[k]) for k in range(len(tasks))]
    if part == "refusals":
        for kind in KINDS:
            given, wrong = np.sum([result for task, result in done if task[2] == kind], axis=0)
            print(f"{kind}: {count * len(targets)} frames, {given} poses given, {wrong} wrong")
        return
    for (target, kind), (frames, losses, errors, shares) in done:
        print(
            f"{Path(target).stem} {kind}: {frames} frames, {losses} lost, rotation "
            f"{np.median(errors):.3f}° median, {np.percentile(errors, 95):.2f}° 95 %, "
            f"translation {100 * np.median(shares):.3f} % of range"
        )
    everything = np.concatenate([errors for _, (_, _, errors, _) in done])
    frames, losses = (sum(result[k] for _, result in done) for k in (0, 1))
    print(f"all: {frames} frames, {losses} lost, {np.median(everything):.3f}° median")
