"""Trajectories of a camera relative to a target, as poses with times.

The camera looks at ``centre_m``, a point of the target; the range is its distance. The target's +Z
points up in the picture unless a docstring states otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview_ground.limits import POSITIVE, check

TrajectoryKind = Literal["circular", "spiral", "vbar", "flyaround", "tumble", "random", "stations"]
TimedPose = tuple[float, Pose]
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryOptions:
    """Options of all kinds; comments name the kinds that use them."""

    frames: int = 100
    dt_s: float = 1.0
    start_range_m: float = 30.0
    end_range_m: float | None = None  # None: same as start; circular stays at start
    centre_m: Triple = (0.0, 0.0, 0.0)
    turn_rad: float = 2.0 * math.pi  # total angle around the target: circular, spiral, flyaround
    inclination_rad: float = math.radians(35.0)  # flyaround: its plane to the target's XY
    approach_axis: Triple = (1.0, 0.0, 0.0)  # vbar, stations: from the target to the camera
    off_axis_max_rad: float = math.radians(15.0)  # stations: the camera lies in this cone
    hops: int = 3  # vbar
    hop_ratio: float = 0.03  # vbar: height of a hop as a share of the distance
    body_rate_rad_s: Triple = (0.005, 0.05, 0.01)  # tumble: initial angular velocity, target axes
    inertia: Triple = (1.0, 1.6, 2.0)  # tumble: principal moments on the target axes, any unit
    bearing_max_rad: float = 0.0  # random, stations: the centre is in this cone about the boresight
    pointing_jitter_rad: float = 0.0  # one sigma each of the camera's x and y, new each frame
    roll_jitter_rad: float = 0.0  # one sigma about the boresight, new each frame
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, 1, math.inf, "frames")
        check(self, POSITIVE, math.inf, "dt_s", "start_range_m", "end_range_m")
        check(self, 0.0, math.inf, "hops", "hop_ratio", "pointing_jitter_rad", "roll_jitter_rad")
        check(self, 0.0, math.radians(89.0), "bearing_max_rad", "off_axis_max_rad")
        triples = ("centre_m", "approach_axis", "body_rate_rad_s", "inertia")
        check(self, -math.inf, math.inf, "turn_rad", "inclination_rad", *triples)
        for name in triples:
            if len(getattr(self, name)) != 3:
                raise RendezviewError(f"{name} must be three numbers, not {getattr(self, name)}")
        if not any(self.approach_axis):
            raise RendezviewError("approach_axis must not be zero")
        a, b, c = sorted(self.inertia)
        if a <= 0.0 or a + b < c * (1.0 - 1e-9):
            raise RendezviewError(
                f"inertia {self.inertia} belongs to no body: moments must be positive, and none "
                "may exceed the sum of the other two"
            )

    @property
    def last_range_m(self) -> float:
        """Range at the end, in metres."""
        return self.start_range_m if self.end_range_m is None else self.end_range_m


def triple(values: Iterable[float]) -> Triple:
    """Three numbers, such as those of an array (3,).

    Raises:
        ValueError: there are not three.
    """
    x, y, z = (float(value) for value in values)
    return x, y, z


def trajectory(kind: TrajectoryKind, options: TrajectoryOptions | None = None) -> list[TimedPose]:
    """Times from 0 in steps of ``dt_s`` with ``camera_from_target`` poses.

    - ``circular``: at ``start_range_m`` in the target's XY plane from +X towards
      +Y, through ``turn_rad``.
    - ``spiral``: the same, with the range changing linearly to ``end_range_m``.
    - ``vbar``: along ``approach_axis``, with the distance linear in time and ``hops`` arcs across
      the axis, whose height shrinks with the distance.
    - ``flyaround``: a closed loop in a plane through the target's X axis tilted by
      ``inclination_rad``; the range reaches ``end_range_m`` half-way and returns.
    - ``tumble``: camera fixed at ``start_range_m``, the target in free tumble about
      ``centre_m``, taken for its centre of mass: :func:`torque_free`.
    - ``random``: attitudes uniform on SO(3), ranges uniform between start and end,
      bearings of the centre uniform over a cone about the boresight.
    - ``stations``: separate places before the target, as a calibration wants them: directions
      uniform over the cone of ``off_axis_max_rad`` about ``approach_axis``, rolls within ± the
      same angle, ranges and bearings as of ``random``.

    Jitter rotates the camera about its optical centre and does not change the range.

    Raises:
        RendezviewError: ``kind`` is unknown, or ``end_range_m`` is given to a kind
            that keeps its range.
    """
    options = options or TrajectoryOptions()
    if kind not in get_args(TrajectoryKind):
        raise RendezviewError(
            f"unknown trajectory {kind!r}: choose one of {', '.join(get_args(TrajectoryKind))}"
        )
    if kind in ("circular", "tumble") and options.last_range_m != options.start_range_m:
        raise RendezviewError(
            f"a {kind} trajectory keeps its range: leave the end range out, or choose spiral"
        )
    rng = np.random.default_rng(options.seed)
    times_s = options.dt_s * np.arange(options.frames, dtype=np.float64)
    progress = np.arange(options.frames) / max(options.frames - 1, 1)
    if kind == "tumble":
        poses = _tumble(options, times_s)
    elif kind == "random":
        poses = _random(options, rng)
    elif kind == "stations":
        poses = _stations(options, rng)
    elif kind == "vbar":
        poses = _vbar(options, progress)
    else:
        poses = _around(kind, options, progress)
    jitter = rng.standard_normal((options.frames, 3)) * (
        options.pointing_jitter_rad,
        options.pointing_jitter_rad,
        options.roll_jitter_rad,
    )
    shaken = Rotation.from_rotvec(jitter).as_matrix()
    return [
        (float(time_s), Pose(turn, np.zeros(3)) @ pose)
        for time_s, turn, pose in zip(times_s, shaken, poses, strict=True)
    ]


def looking_at(camera_m: npt.ArrayLike, centre_m: npt.ArrayLike, up: npt.ArrayLike) -> Pose:
    """``camera_from_target`` of a camera at a point that looks at another point.

    All arguments are (3,) in the target frame; ``up`` points up in the picture.

    Raises:
        ValueError: the points are equal, or ``up`` is parallel to the boresight.
    """
    camera, centre = np.asarray(camera_m, np.float64), np.asarray(centre_m, np.float64)
    z = centre - camera
    x = np.cross(z, np.asarray(up, np.float64))  # y is down, so x = down × z = z × up
    if not np.linalg.norm(x) > 1e-9 * np.linalg.norm(z):
        raise ValueError(f"no view from {camera_m!r} to {centre_m!r} with {up!r} upwards")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Pose(rotation, -rotation @ camera)


def torque_free(
    inertia: npt.ArrayLike, body_rate_rad_s: npt.ArrayLike, times_s: Array
) -> tuple[Array, Array]:
    """Free rotation of a rigid body with principal moments ``inertia`` on its axes.

    Euler's equations I ω' = −ω × I ω and the attitude's q' = q ∘ (0, ω) / 2 are
    integrated together (Dormand–Prince of order 8, relative tolerance 1e-11).

    Returns:
        ``inertial_from_body`` (N, 3, 3), the identity at the first time, and the
        angular velocity in body axes (N, 3).
    """
    from scipy.integrate import solve_ivp  # slow to import, and most flights do not tumble

    moments = np.asarray(inertia, dtype=np.float64)

    def slope(_: float, state: Array) -> Array:
        (x, y, z, w), rate = state[:4], state[4:]
        p, q, r = rate
        return np.array(
            [
                0.5 * (w * p + y * r - z * q),
                0.5 * (w * q + z * p - x * r),
                0.5 * (w * r + x * q - y * p),
                -0.5 * (x * p + y * q + z * r),
                *(-np.cross(rate, moments * rate) / moments),
            ]
        )

    start = np.concatenate([[0.0, 0.0, 0.0, 1.0], np.asarray(body_rate_rad_s, np.float64)])
    if len(times_s) < 2:
        return np.eye(3)[None].repeat(len(times_s), axis=0), start[None, 4:]
    solved = solve_ivp(
        slope,
        (float(times_s[0]), float(times_s[-1])),
        start,
        method="DOP853",
        t_eval=times_s,
        rtol=1e-11,
        atol=1e-13,
    )
    return Rotation.from_quat(solved.y[:4].T).as_matrix(), solved.y[4:].T


def _around(kind: str, options: TrajectoryOptions, progress: Array) -> list[Pose]:
    angle = options.turn_rad * progress
    tilt = options.inclination_rad if kind == "flyaround" else 0.0
    swing = 0.5 - 0.5 * np.cos(angle) if kind == "flyaround" else progress
    range_m = options.start_range_m + (options.last_range_m - options.start_range_m) * swing
    normal = np.array([0.0, -math.sin(tilt), math.cos(tilt)])
    ahead = np.array([0.0, math.cos(tilt), math.sin(tilt)])
    sideways = np.cos(angle)[:, None] * [1.0, 0.0, 0.0] + np.sin(angle)[:, None] * ahead
    centre = np.asarray(options.centre_m)
    # The plane's normal is up, so that the picture does not roll.
    return [
        looking_at(centre + r * s, centre, normal) for r, s in zip(range_m, sideways, strict=True)
    ]


def _vbar(options: TrajectoryOptions, progress: Array) -> list[Pose]:
    axis = np.asarray(options.approach_axis) / np.linalg.norm(options.approach_axis)
    up = np.eye(3)[2 if abs(axis[2]) < 0.9 else 1]
    across = up - (up @ axis) * axis
    across /= np.linalg.norm(across)
    centre = np.asarray(options.centre_m)
    distance_m = options.start_range_m + (options.last_range_m - options.start_range_m) * progress
    height_m = options.hop_ratio * distance_m * np.abs(np.sin(math.pi * options.hops * progress))
    return [
        looking_at(centre + d * axis + h * across, centre, up)
        for d, h in zip(distance_m, height_m, strict=True)
    ]


def _tumble(options: TrajectoryOptions, times_s: Array) -> list[Pose]:
    centre = np.asarray(options.centre_m)
    camera = centre + np.array([options.start_range_m, 0.0, 0.0])
    first = looking_at(camera, centre, [0.0, 0.0, 1.0])
    turns, _ = torque_free(options.inertia, options.body_rate_rad_s, times_s)
    to_centre, from_centre = Pose(np.eye(3), -centre), Pose(np.eye(3), centre)
    return [first @ from_centre @ Pose(turn, np.zeros(3)) @ to_centre for turn in turns]


def _random(options: TrajectoryOptions, rng: np.random.Generator) -> list[Pose]:
    poses = []
    low, high = sorted((options.start_range_m, options.last_range_m))
    for _ in range(options.frames):
        # A normal 4-vector has no preferred direction: uniform on SO(3).
        quat = rng.standard_normal(4)
        range_m = rng.uniform(low, high)
        turn = Pose.from_quat_wxyz(quat, np.zeros(3))
        centre_m = range_m * _in_cone(options.bearing_max_rad, rng)
        poses.append(Pose(turn.rotation, centre_m - turn.rotation @ np.asarray(options.centre_m)))
    return poses


def _stations(options: TrajectoryOptions, rng: np.random.Generator) -> list[Pose]:
    axis = np.asarray(options.approach_axis) / np.linalg.norm(options.approach_axis)
    up = np.eye(3)[2 if abs(axis[2]) < 0.9 else 1]
    centre = np.asarray(options.centre_m)
    # Its boresight is the axis, from the camera to the target: the cone opens backwards.
    along = looking_at(centre + axis, centre, up).rotation
    low, high = sorted((options.start_range_m, options.last_range_m))
    most = options.off_axis_max_rad
    poses = []
    for _ in range(options.frames):
        range_m = rng.uniform(low, high)
        place = centre - range_m * (along.T @ _in_cone(most, rng))
        pose = looking_at(place, centre, along.T @ [0.0, -1.0, 0.0])
        bearing = _in_cone(options.bearing_max_rad, rng)
        aside, _ = Rotation.align_vectors(bearing[None], [[0.0, 0.0, 1.0]])
        roll = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-most, most)])
        poses.append(Pose((aside * roll).as_matrix(), np.zeros(3)) @ pose)
    return poses


def _in_cone(half_rad: float, rng: np.random.Generator) -> Array:
    """A unit vector (3,), uniform over the solid angle of a cone about +Z."""
    cosine = rng.uniform(math.cos(half_rad), 1.0)
    around = rng.uniform(0.0, 2.0 * math.pi)
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    return np.array([sine * math.cos(around), sine * math.sin(around), cosine])
