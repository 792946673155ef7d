"""Targets with joints: first poses at unknown angles, and tracking while the parts turn."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from rendezview.simulation.scene import SceneOptions, render_frame, sun_at_phase
from rendezview.training.joints import posed, with_parts
from rendezview.training.mesh import load_mesh
from scipy.spatial.transform import Rotation

from experiments.frame import nees
from rendezview.estimation.motion import rates_between
from rendezview.geometry.camera import Camera
from rendezview.geometry.joint import apart, within
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.target import Target
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.tracker import Tracker

RIGHT_DEG = 5.0
RANGE_RADII = (3.0, 7.0)
TURN_DEG_S = 0.5  # of every joint, and of the target
LATER_S = 1.0  # between tracked frames
COST_FRAMES = 40


def run(
    model: Path,
    target: Path,
    *,
    frames: int = 200,
    sequences: int = 10,
    length: int = 60,
    phase: float = 30.0,
    seed: int = 61,
) -> None:
    """First poses of FRAMES with any attitude and joint angle; then SEQUENCES of LENGTH frames.

    640 × 480 px, 53°, the Sun up to PHASE degrees from the camera. In the sequences the target
    and its joints turn by 0.5 °/s.
    """
    views, found = ViewModel.load(model), Target.load(target)
    mesh = with_parts(load_mesh(found.mesh_path, found.unit), found)
    camera = Camera.from_fov(640, 480, np.deg2rad(53.0))
    recognizer = Recognizer(views, camera)
    errors, angles, scores, spent = [], [], [], []
    for k in range(frames):
        rng = np.random.default_rng([seed, k])
        pose, sun, truth = _drawn(views, rng, phase)
        image = render_frame(
            posed(mesh, views.joints, truth),
            camera,
            pose,
            sun,
            SceneOptions(sky_frame="camera"),
            rng,
        )
        began_s = time.perf_counter()
        seen = recognizer.recognize(image)
        spent.append(time.perf_counter() - began_s)
        _judge(views, seen, pose, truth, errors, angles, scores)
    _tell("first poses", errors, angles, scores, spent)
    errors, angles, scores, spent = [], [], [], []
    for s in range(sequences):
        rng = np.random.default_rng([seed, frames + s])
        pose, sun, truth = _drawn(views, rng, phase)
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        tracker = Tracker(recognizer)
        for k in range(length):
            turn = Rotation.from_rotvec(np.deg2rad(TURN_DEG_S) * LATER_S * k * axis).as_matrix()
            centre = pose.apply(views.centre_m)
            rotation = turn @ pose.rotation
            now = Pose(rotation, centre - rotation @ views.centre_m)
            turned = truth + np.deg2rad(TURN_DEG_S) * LATER_S * k
            turned = within(views.joints, turned)
            image = render_frame(
                posed(mesh, views.joints, turned), camera, now, sun,
                SceneOptions(sky_frame="camera"), rng,
            )  # fmt: skip
            began_s = time.perf_counter()
            seen = tracker.update(LATER_S * k, image)
            if k > 0:  # the first is searched everywhere
                spent.append(time.perf_counter() - began_s)
                _judge(views, seen, now, turned, errors, angles, scores)
    if sequences:
        _tell(f"tracked, {sequences} sequences", errors, angles, scores, spent)
    _tell_cost(views, mesh, camera, seed)


def _tell_cost(views: ViewModel, mesh, camera: Camera, seed: int) -> None:
    """Time near a prior with the joint free, beside a rigid model of one sheet; same frames."""
    rigid = replace(views, joints=(), angles_rad=np.zeros(0), sheets=())
    ways = {"free": Recognizer(views, camera), "rigid": Recognizer(rigid, camera)}
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for k in range(COST_FRAMES):
        rng = np.random.default_rng([seed, k])
        pose, sun, _ = _drawn(views, rng, 30.0)
        own = posed(mesh, views.joints, views.angles_rad)
        image = render_frame(own, camera, pose, sun, SceneOptions(sky_frame="camera"), rng)
        for name, recognizer in ways.items():
            angles = views.angles_rad if name == "free" else None
            for _ in range(2):  # the first finds memory and caches cold
                began_s = time.perf_counter()
                recognizer.recognize(image, pose, np.deg2rad(3.0), angles_rad=angles)
                took = time.perf_counter() - began_s
            spent[name].append(took)
    free, held = (1e3 * float(np.median(spent[name])) for name in ("free", "rigid"))
    print(f"near a prior: {free:.2f} ms, a rigid model {held:.2f} ms, ratio {free / held:.2f}")


def _drawn(views: ViewModel, rng: np.random.Generator, phase_deg: float):
    """A pose, the direction to the Sun, and angles of the joints."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    line = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    centre = line * rng.uniform(*RANGE_RADII) * views.target_radius_m
    pose = Pose(rotation, centre - rotation @ views.centre_m)
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    sun = sun_at_phase(centre, np.deg2rad(rng.uniform(0.0, phase_deg)), azimuth)
    return pose, sun, np.array([rng.uniform(j.lowest_rad, j.highest_rad) for j in views.joints])


def _judge(views, seen, pose, truth, errors, angles, scores) -> None:
    """Append the errors of one frame: degrees, of the pose and of each joint; NEES of the pose."""
    if seen.pose is None:
        errors.append(np.nan)
        return
    errors.append(np.rad2deg(angle_between(seen.pose, pose, views.symmetries)))
    if errors[-1] < RIGHT_DEG and seen.joints is not None:
        off = apart(views.joints, seen.joints.angles_rad, truth)
        angles.append(np.rad2deg(np.abs(off)).max())
        error = np.concatenate([rates_between(pose, seen.pose, 1.0), off])
        scores.append(nees(error, seen.joints.covariance))


def _tell(name: str, errors, angles, scores, spent) -> None:
    error, right = np.array(errors), np.array(errors) < RIGHT_DEG
    print(
        f"{name}: {len(error)} frames, right {100 * right.mean():.1f} %, "
        f"wrong {100 * (error >= RIGHT_DEG).mean():.1f} %, median {np.median(error[right]):.3f}°; "
        f"joint angle off by {np.median(angles):.3f}° in the median, 95 % below "
        f"{np.quantile(angles, 0.95):.2f}°; NEES (7 unknowns: 6.3) median {np.median(scores):.1f}, "
        f"mean {np.mean(scores):.1f}; {1e3 * np.median(spent):.1f} ms",
        flush=True,
    )
