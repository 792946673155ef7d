"""Draw paths, recognise their frames, and keep the observations for trajectory-accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.trajectories import looking_at, torque_free
from rendezview.training.mesh import load_mesh
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.bundled import find_target
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, Tracker, ViewModel

KINDS = ("circular", "spiral", "vbar", "spin", "tumble")
FRAMES = 100
STEP_S = 2.0
SPAN_S = FRAMES * STEP_S
RATE_RAD_S = 1.0 / SPAN_S
MEAN_MOTION_RAD_S = 0.0011
JITTER_RAD = np.deg2rad(0.3)
INERTIA = (1.0, 1.6, 2.0)
CAMERA = Camera.from_fov(1024, 768, float(np.deg2rad(53.0)))


def true_path(
    kind: str, radius_m: float, centre_m: Array, seed: int
) -> tuple[Callable[[Array], Array], Callable[[Array], tuple[Array, Array]]]:
    """Where the camera is, and how the target turns, at any times; without jitter.

    Returns:
        Times (N,) to camera places (N, 3), target frame; times to ``reference_from_target``
        (N, 3, 3) and the target's angular velocity (N, 3) in its own axes. The reference is a
        frame in which the target's centre is fixed on +z, as the camera's does.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    axes = Rotation.random(random_state=rng).as_matrix()
    ahead, across, normal = axes
    if kind in ("spin", "tumble"):
        direction = rng.standard_normal(3)
        rate = RATE_RAD_S * direction / np.linalg.norm(direction)
        inertia = INERTIA if kind == "tumble" else (1.0, 1.0, 1.0)
        place = centre_m + 3.5 * radius_m * ahead
        first = looking_at(place, centre_m, normal).rotation

        def turn(times_s: Array) -> tuple[Array, Array]:
            grid = np.concatenate([[0.0], times_s])
            unique, back = np.unique(grid, return_inverse=True)
            inertial_from_body, rates = torque_free(inertia, rate, unique)
            return first @ inertial_from_body[back][1:], rates[back][1:]

        def places(times_s: Array) -> Array:
            turned, _ = turn(times_s)
            away = np.array([0.0, 0.0, -3.5 * radius_m])
            return np.asarray(centre_m + np.einsum("nji,j->ni", turned, away))

        return places, turn

    hop_s, hop_phase = SPAN_S / 3.0, rng.uniform(0.0, SPAN_S / 3.0)

    def flown(times_s: Array) -> Array:
        t = np.asarray(times_s, np.float64)[:, None]
        if kind == "vbar":
            distance = radius_m * (6.0 - t / SPAN_S)
            height = 0.03 * distance * np.abs(np.sin(math.pi * (t - hop_phase) / hop_s))
            return np.asarray(centre_m + distance * ahead + height * across)
        distance = radius_m * (3.5 if kind == "circular" else 4.5 - 0.5 * t / SPAN_S)
        angle = RATE_RAD_S * t
        return np.asarray(centre_m + distance * (np.cos(angle) * ahead + np.sin(angle) * across))

    def turned(times_s: Array) -> tuple[Array, Array]:
        up = across if kind == "vbar" else normal
        poses = np.stack([looking_at(p, centre_m, up).rotation for p in flown(times_s)])
        rates = np.tile(-RATE_RAD_S * normal, (len(times_s), 1))
        return poses, (np.zeros_like(rates) if kind == "vbar" else rates)

    return flown, turned


def suns(rotations: Array, still: Array, phase_rad: float, rng: np.random.Generator) -> Array:
    """(N, 3) towards the Sun in the camera's axes: it stands still in space, the orbit turns.

    Args:
        rotations: (N, 3, 3) camera_from_target.
        still: (N, 3, 3) from the axes that keep their place in the orbit to the camera's.
        phase_rad: angle Sun–target–camera in the middle of the segment.
    """
    middle = len(rotations) // 2
    there = sun_at_phase([0.0, 0.0, 1.0], phase_rad, rng.uniform(0.0, 2.0 * math.pi))
    first = still[middle].T @ there
    normal = rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    turns = -MEAN_MOTION_RAD_S * STEP_S * (np.arange(len(rotations)) - middle)
    moved = Rotation.from_rotvec(turns[:, None] * normal).apply(first)
    return np.asarray(np.einsum("nij,nj->ni", still, moved))


def observations(
    model: ViewModel, target: str, kind: str, seed: int, most_phase_rad: float
) -> dict[str, Array]:
    """One segment through the renderer and both trackers, as arrays."""
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, found.unit)
    camera = CAMERA
    centre_m = model.centre_m
    places, turns = true_path(kind, model.target_radius_m, centre_m, seed)
    times_s = STEP_S * np.arange(FRAMES)
    rotations = turns(times_s)[0]
    truth = places(times_s)
    rng = np.random.default_rng([seed, KINDS.index(kind), 1])
    jitter = Rotation.from_rotvec(JITTER_RAD * rng.standard_normal((FRAMES, 3))).as_matrix()
    phase_rad = rng.uniform(0.0, most_phase_rad)
    # A turning target turns in the axes of the orbit, which are the camera's.
    turning = kind in ("spin", "tumble")
    light = suns(jitter @ rotations, jitter if turning else jitter @ rotations, phase_rad, rng)
    options = SceneOptions()
    trackers: tuple[Tracker, Tracker] | None = None
    seen: list[tuple[AppearanceObservation, AppearanceObservation]] = []
    for k in range(FRAMES):
        rotation = jitter[k] @ rotations[k]
        pose = Pose(rotation, -rotation @ truth[k])
        frame = render_frame(mesh, camera, pose, light[k], options, rng, float(times_s[k]))
        if trackers is None:
            trackers = (
                Tracker(Recognizer(model, camera), pose),
                Tracker(Recognizer(model, camera, refine=False), pose),
            )
        seen.append(
            (
                trackers[0].update(float(times_s[k]), frame),
                trackers[1].update(float(times_s[k]), frame),
            )
        )
    refined = [(k, s) for k, (s, _) in enumerate(seen) if s.pose is not None]
    nodes = [(k, s) for k, (_, s) in enumerate(seen) if len(s.points_m)]
    trees = [(k, s.pose) for k, (_, s) in enumerate(seen) if s.pose is not None]
    outlines = [(k, s.signature) for k, (_, s) in enumerate(seen) if s.signature is not None]
    poses = [s.pose for _, s in refined if s.pose is not None]
    return {
        "centre_m": centre_m,
        "radius_m": np.array(model.target_radius_m),
        "times_s": times_s,
        "truth_m": truth,
        "true_rotation": rotations,
        "jitter": jitter,
        "pose_frame": np.array([k for k, _ in refined]),
        "rotation": np.array([p.rotation for p in poses]),
        "translation_m": np.array([p.translation_m for p in poses]),
        "covariance": np.array([s.covariance for _, s in refined]),
        "node_frame": np.concatenate([np.full(len(s.points_m), k) for k, s in nodes]),
        "node_m": np.concatenate([s.points_m for _, s in nodes]),
        "node_weight": np.concatenate([s.weights for _, s in nodes]),
        "outline_frame": np.array([k for k, _ in outlines]),
        "readings": np.array([s.readings for _, s in outlines], np.float32),
        "area_sr": np.array([s.area_sr for _, s in outlines]),
        "centred_from_camera": np.array([s.centred_from_camera for _, s in outlines]),
        "tree_frame": np.array([k for k, _ in trees]),
        "tree_rotation": np.array([pose.rotation for _, pose in trees]),
    }


def run(
    folder: Path, model: Path,
    target: Annotated[str, "mesh, target.toml, or hubble, client, scole"], kinds: list[str], *,
    seeds: tuple[int, int] = (0, 20),
    sun_phase: Annotated[float, "largest in the middle of a segment, degrees"] = 45.0,
) -> None:  # fmt: skip
    """Draw paths, recognise their frames, and keep the observations for trajectory-accuracy.

    FOLDER/<target>-<kind>-<seed>.npz has one segment (poses, active nodes, signatures) of 100
    frames, 2 s apart: 1024 × 768, 53° across. The Sun stands still in space: 0 to --sun-phase
    from behind the camera in the middle of the segment, and as far aside as the camera flies and
    the orbit (0.0011 rad/s) turns before and after that. Noise, blur and pointing jitter are those
    of rendezview simulate; the attitude of the path is random. Two trackers read each frame: one
    with refinement, one with the trees only. An existing file is kept.

    circular: one radian at 3.5 target radii. spiral: the same from 4.5 to 4 radii. vbar: from 6 to
    5 radii, with three hops of 3 % of the distance. spin, tumble: the camera is fixed at 3.5 radii,
    the target turns through one radian about a fixed axis, or freely with moments 1 : 1.6 : 2.
    """
    folder.mkdir(parents=True, exist_ok=True)
    views = ViewModel.load(model)
    for seed in range(*seeds):
        for kind in kinds:
            path = folder / f"{views.name}-{kind}-{seed}.npz"
            if path.exists():
                continue
            arrays = observations(views, target, kind, seed, math.radians(sun_phase))
            np.savez_compressed(path, **arrays)
            print(
                f"{path.name}: {len(arrays['pose_frame'])} poses, "
                f"{len(arrays['node_frame'])} active nodes",
                flush=True,
            )
