"""Closed loop: frames, recognition, fit and correction, beside flights without correction."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.closed_loop import Flight, FlightErrors, Look, Observed, fly
from rendezview.simulation.command import default_camera
from rendezview.training.mesh import Mesh, load_mesh
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview.trajectory import FollowerOptions, Orbit, PathFollower, Plan, Shape

KINDS = ("circular", "spiral", "vbar")
SPAN_S, STEP_S = 1200.0, 10.0
MEAN_MOTION_RAD_S = 0.0011
PRIOR_RAD = np.deg2rad(20.0)


def plan_of(kind: str, radius_m: float) -> Plan:
    numbers: dict[str, object]
    rate = 2.0 * math.pi / SPAN_S
    if kind == "vbar":
        numbers = {
            "axis": np.array([0.0, 1.0, 0.0]),
            "across": np.array([1.0, 0.0, 0.0]),
            "distance_m": 6.0 * radius_m,
            "speed_m_s": 2.4 * radius_m / SPAN_S,
            "hop_ratio": 0.03,
            "hop_s": SPAN_S / 3.0,
        }
    else:
        numbers = {"radius_m": 3.6 * radius_m, "rate_rad_s": rate, "frame": np.eye(3)}
        if kind == "spiral":
            numbers |= {"radius_m": 5.0 * radius_m, "radius_rate_m_s": -1.4 * radius_m / SPAN_S}
    return Plan(
        shape=Shape.DRIFT,
        kind=kind,
        numbers=numbers,
        end_s=SPAN_S,
        orbit=Orbit(MEAN_MOTION_RAD_S, np.eye(3)),
        turn_rad=None,
        segment_s=1.0 / rate,
        deviation=True,
    )


def eye(model: ViewModel, mesh: Mesh, refine: bool, rng: np.random.Generator) -> Look:
    """Draws the frame of a pose and recognises it."""
    camera = default_camera()
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    tracker: Tracker | None = None

    def look(time_s: float, pose: Pose) -> Observed:
        nonlocal tracker
        if tracker is None:
            turn = rng.standard_normal(3)
            turn *= PRIOR_RAD * rng.uniform() / np.linalg.norm(turn)
            rotation = Rotation.from_rotvec(turn).as_matrix() @ pose.rotation
            ahead = np.array([0.0, 0.0, pose.apply(model.centre_m)[2]])
            prior = Pose(rotation, ahead - rotation @ model.centre_m)
            tracker = Tracker(Recognizer(model, camera, refine=refine), prior)
        sun = sun_at_phase(pose.apply(model.centre_m), 0.0, azimuth)
        frame = render_frame(mesh, camera, pose, sun, SceneOptions(), rng, time_s)
        observed = tracker.update(time_s, frame)
        return observed.pose, observed.covariance, *observed.cloud

    return look


def flights(
    model: ViewModel, mesh: Mesh, kind: str, seed: int, refine: bool, own_attitude: bool
) -> tuple[Flight, Flight]:
    """With corrections, and without."""
    plan = plan_of(kind, model.target_radius_m)
    common = {"step_s": STEP_S, "end_s": SPAN_S - STEP_S}
    errors = FlightErrors()
    key = [seed, KINDS.index(kind)]
    options = FollowerOptions(turn_rad=None, segment_s=plan.segment_s, reach=0.5, spin=False)
    follower = PathFollower(model.centre_m, plan=plan, options=options)
    look = eye(model, mesh, refine, np.random.default_rng([*key, 1]))
    corrected = fly(
        plan, model.centre_m, errors, np.random.default_rng(key), look=look, follower=follower,
        own_attitude=own_attitude, **common,
    )  # fmt: skip
    alone = fly(plan, model.centre_m, errors, np.random.default_rng(key), **common)
    return corrected, alone


def run(
    model: Path, target: Annotated[str, "mesh, target.toml, or hubble, client, scole"], *,
    kinds: list[str] = KINDS, seeds: tuple[int, int] = (0, 20),
    nodes: Annotated[bool, "active nodes only, no refinement"] = False,
    by_target: Annotated[bool, "no star tracker: the target's attitude instead"] = False,
) -> None:  # fmt: skip
    """Closed loop: frames, recognition, fit and correction, beside flights without correction.

    Each flight lasts 1200 s, a frame every 10 s (640 × 480, 53° across, drawn at the true pose by
    our own simulator, Sun behind the camera). Mean motion 0.0011 rad/s. The first frame's attitude
    is given to 20°. circular: one turn at 3.6 target radii in the plane of the orbit; spiral: one
    turn from 5 to 3.6 radii; vbar: from 6 to 3.6 radii along the orbital velocity, with three
    hops. A star tracker gives the chaser's own attitude to 0.02°. The same errors are flown without
    corrections. Printed: root mean square distance to the plan, and the ratio.
    """
    views = ViewModel.load(model)
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, found.unit)
    for kind in kinds:
        ratios = []
        for seed in range(*seeds):
            corrected, alone = flights(views, mesh, kind, seed, not nodes, not by_target)
            ratios.append(alone.rms_m / corrected.rms_m)
            print(
                f"{kind} seed {seed}: {corrected.rms_m:.3f} m corrected, {alone.rms_m:.2f} m not, "
                f"{ratios[-1]:.1f} ×; {corrected.corrections} corrections, "
                f"{corrected.corrections_m_s:.3f} m/s",
                flush=True,
            )
        print(
            f"{kind}: {len(ratios)} flights, least ratio {min(ratios):.1f}, median "
            f"{np.median(ratios):.1f}, {sum(r >= 10.0 for r in ratios)} of at least 10"
        )
