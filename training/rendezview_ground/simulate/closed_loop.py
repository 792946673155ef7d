"""A flight along a plan: Clohessy–Wiltshire motion, imperfect thrusts, drag, corrections.

One impulse per step follows the plan; without errors the flight would stay on the plan to the
millimetre. Every impulse has errors of size and direction, drag differs from the target's, and
the flight starts beside the plan. The function ``look`` gives the measurements of each step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.trajectory import Correction, PathFollower, Plan, Report
from rendezview.trajectory.relative_orbit import push, transition, velocity_to_reach
from rendezview_ground.simulate.trajectories import looking_at

# Time and true camera_from_target → measurement of the follower: pose, covariance, points, weights.
Observed = tuple[Pose | None, Array | None, Array, Array]
Look = Callable[[float, Pose], Observed]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightErrors:
    """One σ each, drawn once per flight unless the comment says otherwise."""

    place_m: float = 0.3  # each axis, at the start
    velocity_m_s: float = 0.004  # each axis, at the start
    thrust_scale: float = 0.02  # share of every impulse, the same for all
    thrust_scale_each: float = 0.01  # share of every impulse, new for each
    thrust_askew_rad: float = math.radians(0.5)  # about each axis, the same in all
    drag_m_s2: float = 2e-5  # against the orbital velocity; a value, not a σ
    pointing_rad: float = math.radians(0.3)  # of the camera, each axis, new for each frame
    attitude_rad: float = math.radians(
        0.02
    )  # of the star tracker's attitude, each axis, new for each frame


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """The flown path, in Hill's frame."""

    times_s: Array  # (N,)
    places_m: Array  # (N, 3) true
    planned_m: Array  # (N, 3)
    reports: list[Report]  # of the corrected flight
    corrections: int
    corrections_m_s: float  # sum of their sizes

    @property
    def rms_m(self) -> float:
        """Root mean square of the distance to the plan."""
        off = self.places_m - self.planned_m
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def fly(
    plan: Plan,
    centre_m: Array,
    errors: FlightErrors,
    rng: np.random.Generator,
    *,
    step_s: float,
    end_s: float,
    look: Look | None = None,
    follower: PathFollower | None = None,
    own_attitude: bool = True,
    first: int = 6,
    every: int = 4,
) -> Flight:
    """Fly a plan; the same ``rng`` seed gives the same errors with and without corrections.

    Args:
        plan: with an orbit, whose target keeps its attitude to the Earth.
        centre_m: (3,) of the plan, target frame.
        step_s: between impulses, and between frames.
        look, follower: of a corrected flight; None without corrections.
        own_attitude: the follower receives the chaser's attitude in Hill's frame, as from a star
            tracker; False: it knows the target's attitude only.
        first, every: steps to the first correction, and from one to the next.

    Raises:
        ValueError: the plan has no orbit, or its target turns in Hill's frame.
    """
    if plan.orbit is None or plan.orbit.inertial:
        raise ValueError("a flight needs a plan in an orbit, about a target that faces the Earth")
    n = plan.mean_motion_rad_s
    target_from_hill = plan.orbit.hill_from_target.T
    times = np.arange(plan.start_s, end_s + 0.5 * step_s, step_s)
    planned = plan.places(np.append(times, times[-1] + step_s))
    arrivals, impulses = _impulses(planned, n, step_s)
    free = transition(n, step_s)
    dragged = push(n, step_s, [0.0, -errors.drag_m_s2, 0.0])
    scale = 1.0 + errors.thrust_scale * rng.standard_normal()
    askew = Rotation.from_rotvec(errors.thrust_askew_rad * rng.standard_normal(3)).as_matrix()
    start = rng.standard_normal(6) * np.repeat([errors.place_m, errors.velocity_m_s], 3)
    state = np.concatenate([planned[0], arrivals[0]]) + start
    shaken = errors.pointing_rad * rng.standard_normal((len(times), 3))
    reported = errors.attitude_rad * rng.standard_normal((len(times), 3))
    uneven = 1.0 + errors.thrust_scale_each * rng.standard_normal((len(times), 2))
    places, reports = [], []
    count, spent = 0, 0.0
    for k, time_s in enumerate(times):
        places.append(state[:3].copy())
        if look is not None and follower is not None:
            camera_m = centre_m + target_from_hill @ state[:3]
            turn = Rotation.from_rotvec(shaken[k]).as_matrix()
            up = target_from_hill @ _up(state[:3])
            pose = Pose(turn, np.zeros(3)) @ looking_at(camera_m, centre_m, up)
            attitude = None
            if own_attitude:
                off = Rotation.from_rotvec(reported[k]).as_matrix()
                attitude = plan.orbit.hill_from_target @ pose.rotation.T @ off
            observed = look(float(time_s), pose)
            report = follower.update(float(time_s), *observed, path_from_camera=attitude)
            reports.append(report)
            given = report.correction
            half_way = isinstance(given, Correction) and (given.reach_s - time_s >= 5.0 * step_s)
            if half_way and k >= first and (k - first) % every == 0:
                assert isinstance(given, Correction)
                follower.burn(float(time_s), given.delta_v_m_s)
                state[3:] += scale * uneven[k, 1] * (askew @ given.delta_v_m_s)
                count, spent = count + 1, spent + given.size_m_s
        state[3:] += scale * uneven[k, 0] * (askew @ impulses[k])
        state = free @ state + dragged
    return Flight(times, np.array(places), planned[:-1], reports, count, spent)


def _impulses(planned: Array, mean_motion_rad_s: float, step_s: float) -> tuple[Array, Array]:
    """Velocities (N, 3) on arrival at each planned place, and the impulses there."""
    free = transition(mean_motion_rad_s, step_s)
    leaving = []
    for here, there in pairwise(planned):
        velocity = velocity_to_reach(mean_motion_rad_s, step_s, there - free[:3, :3] @ here)
        if velocity is None:
            raise ValueError(f"a step of {step_s} s is no part of an orbit")
        leaving.append(velocity)
    arriving = [
        free[3:, :3] @ here + free[3:, 3:] @ velocity
        for here, velocity in zip(planned[:-1], leaving, strict=True)
    ]
    arrivals = np.array([leaving[0], *arriving[:-1]])
    return arrivals, np.array(leaving) - arrivals


def _up(place: Array) -> Array:
    """Hill's normal, or the radial direction if the camera is on the normal."""
    return np.asarray(np.eye(3)[2 if abs(place[2]) < 0.9 * np.linalg.norm(place) else 0])
