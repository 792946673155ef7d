"""Poses close to a docking ring, where the target overflows the picture, from a prior."""

from __future__ import annotations

import math
import pickle
import time
from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.simulation import MitsubaOptions, SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.shading import ShadingOptions
from rendezview.simulation.trajectories import looking_at
from rendezview.training.mesh import Mesh, load_mesh
from scipy.spatial.transform import Rotation

from experiments.frame import Log, show, table_of, write_log
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.bundled import find_target
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance import Recognizer, ViewModel

CAMERA = Camera(1024, 1024, 800.0, 800.0, 511.5, 511.5)
RANGES_M = (10.0, 8.0, 6.5, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.2, 1.0)
# Of a wrong answer: as in pose-accuracy for the attitude, tightened since the prior is close.
WRONG_RAD, WRONG_RANGE = math.radians(1.0), 0.01


def drawn(
    mesh: Mesh, ring: DockingRing, range_m: float, tilt_deg: float, mitsuba: bool,
    rng: np.random.Generator,
) -> tuple[np.ndarray, Pose]:  # fmt: skip
    """A frame before the ring at any roll, Sun 10–40° from behind the camera, and its pose."""
    across = np.eye(3)[int(np.argmin(np.abs(ring.axis)))]
    facing = looking_at(ring.centre_m + range_m * ring.axis, ring.centre_m, across).rotation
    roll = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * math.pi)]).as_matrix()
    tilt = Rotation.from_rotvec(math.radians(tilt_deg) * rng.standard_normal(3)).as_matrix()
    rotation = tilt @ roll @ facing
    centre = np.array([*(0.006 * range_m * rng.standard_normal(2)), range_m])
    pose = Pose(rotation, centre - rotation @ ring.centre_m)
    phase = math.radians(rng.uniform(10.0, 40.0))
    sun = sun_at_phase(pose.apply(mesh.bounding_sphere[0]), phase, rng.uniform(0.0, 2 * math.pi))
    options = SceneOptions(shading=ShadingOptions(samples=2))
    if mitsuba:
        options = SceneOptions(mitsuba=MitsubaOptions())
    return render_frame(mesh, CAMERA, pose, sun, options, rng), pose


def off(pose: Pose, degrees: float, share: float, ring: DockingRing, rng: np.random.Generator
        ) -> Pose:  # fmt: skip
    """A prior: the pose with σ ``degrees`` of attitude and ``share`` of range at the ring."""
    turn = Rotation.from_rotvec(math.radians(degrees) * rng.standard_normal(3) / math.sqrt(3.0))
    rotation = turn.as_matrix() @ pose.rotation
    centre = pose.apply(ring.centre_m)
    centre = centre + share * np.linalg.norm(centre) * rng.standard_normal(3)
    return Pose(rotation, centre - rotation @ ring.centre_m)


def errors(pose: Pose, covariance: Array, truth: Pose, ring: DockingRing) -> dict[str, float]:
    axis = float(np.linalg.norm(np.cross(pose.rotation @ ring.axis, truth.rotation @ ring.axis)))
    centre = float(np.linalg.norm(pose.apply(ring.centre_m) - truth.apply(ring.centre_m)))
    turn = Rotation.from_matrix(pose.rotation @ truth.rotation.T).as_rotvec()
    both = np.concatenate([turn, pose.translation_m - truth.translation_m])
    return {
        "axis_deg": math.degrees(math.asin(min(axis, 1.0))),
        "attitude_rad": pose.angle_to(truth),
        "centre_m": centre,
        "nees": float(both @ np.linalg.solve(covariance, both)),
    }


def run(
    model: Annotated[Path, "view model of the target"], *,
    target: str = "client", count: int = 10, seed: int = 1, tilt_deg: float = 1.0,
    prior_deg: float = 0.5, prior_share: float = 0.003,
    mitsuba: Annotated[bool, "frames by Mitsuba, not by the fast simulator"] = False,
    frames: Annotated[Path | None, "keep the frames here, or read them"] = None, json: Log = None,
) -> None:  # fmt: skip
    """Poses close to a docking ring, where the target overflows the picture, from a prior.

    COUNT frames at each range. A pose given is wrong if it is off by 1°, or its ring by 1 % of the
    range. The prior is off by PRIOR_DEG and PRIOR_SHARE of the range across and along, one σ.
    """
    found = find_target(target)
    mesh, ring = load_mesh(found.mesh_path, found.unit), found.docking_ring
    assert ring is not None
    rng = np.random.default_rng([8, seed])
    if frames is not None and frames.exists():
        pictures = pickle.loads(frames.read_bytes())
    else:
        pictures = [
            (range_m, *drawn(mesh, ring, range_m, tilt_deg, mitsuba, rng))
            for range_m in RANGES_M
            for _ in range(count)
        ]
        if frames is not None:
            frames.write_bytes(pickle.dumps(pictures))
    recognizer = Recognizer(ViewModel.load(model), CAMERA)
    rng, answers = np.random.default_rng([9, seed]), []
    for k, (range_m, image, truth) in enumerate([pictures[0], *pictures]):
        prior = off(truth, prior_deg, prior_share, ring, rng)
        began = time.perf_counter()
        seen = recognizer.recognize(image, prior, math.radians(5.0))
        line = {"range_m": range_m, "status": str(seen.status), "reason": seen.reason}
        line["ms"] = 1e3 * (time.perf_counter() - began)
        if seen.found is not None:
            line |= {"share": seen.found.best.inlier_ratio, "points": seen.found.best.points}
        if seen.pose is not None and seen.covariance is not None:
            line |= errors(seen.pose, seen.covariance, truth, ring)
        if k:  # the first is compiling
            answers.append(line)
    names = ("given", "wrong", "axis, °", "95 %", "ring, mm", "NEES mean", "median", "ms", "most")
    table = table_of("poses close in", ("range, m", *names))
    for range_m in RANGES_M:
        here = [a for a in answers if a["range_m"] == range_m]
        given = [a for a in here if "nees" in a]
        wrong = [
            a
            for a in given
            if a["attitude_rad"] > WRONG_RAD or a["centre_m"] > WRONG_RANGE * range_m
        ]
        if not here:
            continue
        right = [a for a in given if a not in wrong]
        axis = [a["axis_deg"] for a in right] or [math.nan]
        nees = [a["nees"] for a in right] or [math.nan]
        centre = [1e3 * a["centre_m"] for a in right] or [math.nan]
        table.add_row(
            f"{range_m:g}", f"{len(given)}/{len(here)}", str(len(wrong)),
            f"{np.median(axis):.3f}", f"{np.percentile(axis, 95):.3f}", f"{np.median(centre):.2f}",
            f"{np.mean(nees):.1f}", f"{np.median(nees):.1f}",
            f"{np.median([a['ms'] for a in here]):.1f}", f"{max(a['ms'] for a in here):.1f}",
        )  # fmt: skip
    show(table)
    write_log(json, answers)
