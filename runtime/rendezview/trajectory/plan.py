"""The planned path: where the camera should be at any time, and what to fit to it.

A plan is about its centre, a point of the target. Its axes are the target's, or, where an orbit
is given, those of Hill's frame (x outwards from the Earth, y along the orbital velocity).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Array
from rendezview.io.files import StrPath, checked, read_toml
from rendezview.trajectory.relative_orbit import transition
from rendezview.trajectory.shapes import Shape, frame_of

# Half a step of the difference that gives a velocity, seconds.
_SLOPE_S = 1e-3  # Source: by construction, between rounding and curvature


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """How the target flies about the Earth, and how it keeps its attitude meanwhile."""

    mean_motion_rad_s: float
    hill_from_target: Array  # (3, 3) at the plan's time 0
    inertial: bool = False  # the target keeps its attitude to the stars, not to the Earth


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path with times.

    Raises:
        ValueError: parameters of no path; see ``load_plan`` for files.
    """

    shape: Shape  # fitted to the cloud
    kind: str  # circular, spiral, vbar, orbit, way_points
    numbers: dict[str, Any]
    start_s: float = 0.0
    end_s: float = math.inf
    centre_m: Array | None = None  # target frame; None: the model's view centre
    orbit: Orbit | None = None
    turn_rad: float | None = 1.0  # of a segment …
    segment_s: float | None = None  # … or its time
    deviation: bool = False  # fit the deviation from the plan, as Clohessy and Wiltshire's motion

    @property
    def mean_motion_rad_s(self) -> float:
        """0 without an orbit: motion without gravity."""
        return 0.0 if self.orbit is None else self.orbit.mean_motion_rad_s

    def path_from_target(self, time_s: float) -> Array:
        """(3, 3) from the target's axes to the plan's, for a target that keeps its attitude."""
        if self.orbit is None:
            return np.eye(3)
        if not self.orbit.inertial:
            return self.orbit.hill_from_target
        # Hill's frame turns about its own +z; an inertially fixed vector turns back in it.
        angle = -self.orbit.mean_motion_rad_s * (time_s - self.start_s)
        c, s = math.cos(angle), math.sin(angle)
        back = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(back @ self.orbit.hill_from_target)

    def places(self, times_s: npt.ArrayLike) -> Array:
        """(N, 3) m about the centre, plan's axes, at times (N,); beyond its ends it goes on."""
        t = np.atleast_1d(np.asarray(times_s, np.float64)) - self.start_s
        n = self.numbers
        if self.kind == "way_points":
            return np.asarray(n["spline"](t + self.start_s))
        if self.kind == "orbit":
            first = np.concatenate([n["position_m"], n["velocity_m_s"]])
            return np.array(
                [(transition(self.mean_motion_rad_s, float(dt)) @ first)[:3] for dt in t]
            )
        if self.kind == "vbar":
            axis, across = n["axis"], n["across"]
            distance = n["distance_m"] - n["speed_m_s"] * t
            high = n["hop_ratio"] * distance * np.abs(np.sin(math.pi * t / n["hop_s"]))
            return np.asarray(distance[:, None] * axis + high[:, None] * across)
        radius = n["radius_m"] + n.get("radius_rate_m_s", 0.0) * t
        angle = n["rate_rad_s"] * t
        circle = (
            np.cos(angle)[:, None] * n["frame"][:, 0] + np.sin(angle)[:, None] * n["frame"][:, 1]
        )
        return np.asarray(radius[:, None] * circle)

    def velocity(self, time_s: float) -> Array:
        """(3,) m/s, plan's axes."""
        after, before = self.places([time_s + _SLOPE_S, time_s - _SLOPE_S])
        return np.asarray((after - before) / (2.0 * _SLOPE_S))

    def out_of(self, time_s: float) -> str | None:
        """Why the plan does not cover a time; None where it does."""
        if time_s < self.start_s - 1e-9:
            return f"the plan begins at {self.start_s:g} s"
        if time_s > self.end_s + 1e-9:
            return f"the plan ends at {self.end_s:g} s"
        return None


_Number = FiniteFloat
_Positive = Annotated[FiniteFloat, Field(gt=0.0)]
_Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _Circular(_Table):
    radius_m: _Positive
    rate_rad_s: _Positive
    towards: _Vector
    start: _Vector


class _Spiral(_Circular):
    radius_rate_m_s: _Number


class _Vbar(_Table):
    axis: _Vector
    distance_m: _Positive
    speed_m_s: _Number
    hop_ratio: Annotated[FiniteFloat, Field(ge=0.0)] = 0.0
    hop_s: _Positive = 1.0
    across: _Vector | None = None


class _OrbitPath(_Table):
    position_m: _Vector
    velocity_m_s: _Vector


class _WayPoint(_Table):
    time_s: _Number
    position_m: _Vector


class _OrbitTable(_Table):
    mean_motion_rad_s: Annotated[FiniteFloat, Field(ge=0.0)]
    radial: _Vector
    along_track: _Vector
    attitude: Literal["hill", "inertial"] = "hill"


class _Segment(_Table):
    shape: Literal["circular", "spiral", "vbar", "orbit", "drift"] | None = None
    turn_rad: Annotated[FiniteFloat, Field(gt=0.0, lt=math.pi)] | None = None
    time_s: _Positive | None = None
    deviation: bool = False


class PlanFile(_Table):
    """The content of a plan file, docs/files-plan.md."""

    start_s: _Number = 0.0
    end_s: _Number | None = None
    centre_m: _Vector | None = None
    circular: _Circular | None = None
    spiral: _Spiral | None = None
    vbar: _Vbar | None = None
    orbit_path: _OrbitPath | None = None
    way_points: Annotated[list[_WayPoint], Field(min_length=2)] | None = None
    orbit: _OrbitTable | None = None
    segment: _Segment = _Segment()


_PLAN_FILE = TypeAdapter(PlanFile)
_KINDS = ("circular", "spiral", "vbar", "orbit_path", "way_points")
_FITTED = {
    "circular": Shape.CIRCULAR,
    "spiral": Shape.SPIRAL,
    "vbar": Shape.VBAR,
    "orbit_path": Shape.ORBIT,
    "way_points": Shape.DRIFT,
}


def load_plan(path: StrPath) -> Plan:
    """Read a plan file (TOML, docs/files-plan.md). Errors as of `read_plan` and `plan_of`."""
    return plan_of(read_plan(path), str(path))


def read_plan(path: StrPath) -> PlanFile:
    """The content of a plan file.

    Raises:
        RendezviewError: missing, not TOML, an unknown or wrong key.
    """
    return checked(_PLAN_FILE, read_toml(path, "a plan"), str(path))


def plan_of(file: PlanFile, path: str) -> Plan:
    """The plan of a plan file's content; ``path`` names it in errors.

    Raises:
        RendezviewError: no path or more than one, directions that span no plane, way points whose
            times do not rise.
    """
    given = [kind for kind in _KINDS if getattr(file, kind) is not None]
    if len(given) != 1:
        raise RendezviewError(
            f"{path}: {len(given)} paths: give exactly one of {', '.join(_KINDS)}"
        )
    kind = given[0]
    with explained(f"{path}: "):
        numbers, first_s, last_s = _numbers(kind, getattr(file, kind))
        orbit = None if file.orbit is None else _orbit(file.orbit)
    if kind == "orbit_path" and orbit is None:
        raise RendezviewError(f"{path}: orbit_path is motion in an orbit: give [orbit] too")
    start_s = first_s if first_s is not None else file.start_s
    end_s = file.end_s if file.end_s is not None else (math.inf if last_s is None else last_s)
    if end_s <= start_s:
        raise RendezviewError(f"{path}: the plan ends at {end_s:g} s, before it begins")
    segment = file.segment
    shape = _FITTED[kind] if segment.shape is None else Shape(segment.shape)
    turning = kind in ("circular", "spiral")
    return Plan(
        shape=shape,
        kind="orbit" if kind == "orbit_path" else kind,
        numbers=numbers,
        start_s=start_s,
        end_s=end_s,
        centre_m=None if file.centre_m is None else np.array(file.centre_m),
        orbit=orbit,
        turn_rad=segment.turn_rad or (1.0 if turning and segment.time_s is None else None),
        segment_s=segment.time_s,
        deviation=segment.deviation or kind == "way_points",
    )


def _numbers(kind: str, table: Any) -> tuple[dict[str, Any], float | None, float | None]:
    """Parameters of a path, and its first and last time where it has them."""
    if kind in ("circular", "spiral"):
        start, towards = np.array(table.start), np.array(table.towards)
        normal = np.cross(start, towards)
        if not np.linalg.norm(normal) > 1e-9 * np.linalg.norm(start) * np.linalg.norm(towards):
            raise ValueError(f"{kind}: start and towards must not lie along one line")
        numbers = {"radius_m": table.radius_m, "rate_rad_s": table.rate_rad_s}
        numbers |= {"frame": frame_of(normal, start)}
        if kind == "spiral":
            numbers["radius_rate_m_s"] = table.radius_rate_m_s
        return numbers, None, None
    if kind == "vbar":
        axis = np.array(table.axis)
        if not np.any(axis):
            raise ValueError("vbar: axis must not be zero")
        axis = axis / np.linalg.norm(axis)
        up = np.eye(3)[2 if abs(axis[2]) < 0.9 else 1]
        across = up if table.across is None else np.array(table.across)
        across = across - (across @ axis) * axis
        if not np.linalg.norm(across) > 1e-9:
            raise ValueError("vbar: across must not lie along the axis")
        numbers = {"axis": axis, "across": across / np.linalg.norm(across)}
        numbers |= {name: getattr(table, name) for name in ("distance_m", "speed_m_s")}
        return numbers | {"hop_ratio": table.hop_ratio, "hop_s": table.hop_s}, None, None
    if kind == "orbit_path":
        place, velocity = np.array(table.position_m), np.array(table.velocity_m_s)
        return {"position_m": place, "velocity_m_s": velocity}, None, None
    from scipy.interpolate import CubicSpline  # slow to import, and most plans have no table

    times = np.array([point.time_s for point in table])
    if not np.all(np.diff(times) > 0.0):
        raise ValueError("way_points: the times must rise")
    spline = CubicSpline(times, np.array([point.position_m for point in table]))
    return {"spline": spline}, float(times[0]), float(times[-1])


def _orbit(table: _OrbitTable) -> Orbit:
    radial, along = np.array(table.radial), np.array(table.along_track)
    normal = np.cross(radial, along)
    if not np.linalg.norm(normal) > 1e-9 * np.linalg.norm(radial) * np.linalg.norm(along):
        raise ValueError("orbit: radial and along_track must not lie along one line")
    target_from_hill = frame_of(normal, radial)
    return Orbit(table.mean_motion_rad_s, target_from_hill.T, table.attitude == "inertial")
