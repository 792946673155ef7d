"""Paths of trajectory-accuracy: their truth, their frames, and what both trackers see in them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.trajectories import looking_at, torque_free

KINDS = ("circular", "spiral", "vbar", "spin", "tumble")
FRAMES = 100
STEP_S = 2.0
SPAN_S = FRAMES * STEP_S
RATE_RAD_S = 1.0 / SPAN_S
MEAN_MOTION_RAD_S = 0.0011
JITTER_RAD = np.deg2rad(0.3)
INERTIA = (1.0, 1.6, 2.0)
MOST_PHASE_RAD = math.radians(45.0)  # of the Sun, in the middle of a segment
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


def observations(model: ViewModel, mesh: Mesh, kind: str, seed: int) -> dict[str, np.ndarray]:
    """One segment through the renderer and both trackers, as arrays."""
    centre_m = model.centre_m
    places, turns = true_path(kind, model.target_radius_m, centre_m, seed)
    times_s = STEP_S * np.arange(FRAMES)
    rotations, truth = turns(times_s)[0], places(times_s)
    rng = np.random.default_rng([seed, KINDS.index(kind), 1])
    jitter = Rotation.from_rotvec(JITTER_RAD * rng.standard_normal((FRAMES, 3))).as_matrix()
    phase_rad = rng.uniform(0.0, MOST_PHASE_RAD)
    # A turning target turns in the axes of the orbit, which are the camera's.
    turned = jitter @ rotations
    light = suns(turned, jitter if kind in ("spin", "tumble") else turned, phase_rad, rng)
    poses = [Pose(j @ r, -(j @ r) @ t) for j, r, t in zip(jitter, rotations, truth, strict=True)]
    both = (Recognizer(model, CAMERA), Recognizer(model, CAMERA, refine=False))
    trackers = [Tracker(recognizer, poses[0]) for recognizer in both]
    refined, outlines, trees, nodes = [], [], [], []
    for k, (time_s, pose) in enumerate(zip(times_s.tolist(), poses, strict=True)):
        frame = render_frame(mesh, CAMERA, pose, light[k], SceneOptions(), rng, time_s)
        fine, rough = (tracker.update(time_s, frame) for tracker in trackers)
        refined += [(k, fine.pose, fine.covariance)] * (fine.pose is not None)
        nodes += [(k, rough.points_m, rough.weights)] * bool(len(rough.points_m))
        trees += [(k, rough.pose)] * (rough.pose is not None)
        outlines += [(k, rough.signature)] * (rough.signature is not None)
    return {
        "centre_m": centre_m, "radius_m": np.array(model.target_radius_m), "times_s": times_s,
        "truth_m": truth, "true_rotation": rotations, "jitter": jitter,
        "pose_frame": np.array([k for k, _, _ in refined]),
        "rotation": np.array([pose.rotation for _, pose, _ in refined]),
        "translation_m": np.array([pose.translation_m for _, pose, _ in refined]),
        "covariance": np.array([spread for _, _, spread in refined]),
        "node_frame": np.concatenate([np.full(len(points), k) for k, points, _ in nodes]),
        "node_m": np.concatenate([points for _, points, _ in nodes]),
        "node_weight": np.concatenate([weights for _, _, weights in nodes]),
        "outline_frame": np.array([k for k, _ in outlines]),
        "readings": np.array([s.readings for _, s in outlines], np.float32),
        "area_sr": np.array([s.area_sr for _, s in outlines]),
        "centred_from_camera": np.array([s.centred_from_camera for _, s in outlines]),
        "tree_frame": np.array([k for k, _ in trees]),
        "tree_rotation": np.array([pose.rotation for _, pose in trees]),
    }  # fmt: skip
