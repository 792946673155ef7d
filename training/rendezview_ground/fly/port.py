"""The port to dock at, and where the chaser stands before it: the same sums for truth and state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing, Target
from rendezview_ground.fly.options import EnvelopeOptions, FlyPlan
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.trajectories import looking_at

# Of the target's radius, of a port without a ring. Source: chosen, two spheres of near views
_SEEN_RADII = 0.1
# Of the target's radius from its centre: what is farther is not on it. Source: chosen, twice a boom
_FARTHEST_RADII = 2.0
_AHEAD = np.array([0.0, 0.0, 1.0])  # the boresight, camera frame


@dataclass(frozen=True, slots=True, eq=False)
class Port:
    """Where to dock, target frame."""

    centre_m: Array  # (3,)
    axis: Array  # (3,) unit, outwards
    facing: Array  # (3, 3) camera_from_target of an aligned chaser
    ahead_m: float  # the chaser's docking plane before its camera
    behind_m: float  # its centre of mass behind the camera
    ring: DockingRing | None  # None: no ring sensor

    @classmethod
    def of(cls, target: Target, plan: FlyPlan) -> Port:
        """The plan's port, or the target's docking ring.

        Raises:
            RendezviewError: neither is given, or the axis is zero.
        """
        given, ring = plan.port, target.docking_ring
        if given.centre_m is not None and given.axis is not None:
            centre, axis = np.array(given.centre_m), np.array(given.axis)
            if not np.linalg.norm(axis) > 0.0:
                raise RendezviewError("port.axis must not be zero: give the way out of the port")
            axis = axis / np.linalg.norm(axis)
            ring = None if given.radius_m is None else DockingRing(centre, axis, given.radius_m)
        elif ring is None:
            raise RendezviewError(
                f"target {target.name!r} has no docking ring: give port.centre_m and port.axis "
                "in the plan"
            )
        else:
            centre, axis = ring.centre_m, ring.axis / np.linalg.norm(ring.axis)
        up = np.eye(3)[int(np.argmin(np.abs(axis)))]
        facing = looking_at(centre + axis, centre, up).rotation
        chaser = plan.chaser
        return cls(centre, axis, facing, chaser.port_ahead_m, chaser.mass_behind_m, ring)

    def must_be_on(self, mesh: Mesh) -> None:
        """Refuses a port that is far from its target: millimetres, or the axes of another file."""
        centre_m, radius_m = mesh.bounding_sphere
        away_m = float(np.linalg.norm(self.centre_m - centre_m))
        if away_m > _FARTHEST_RADII * radius_m:
            raise RendezviewError(
                f"the port is {away_m:.3g} m from the centre of a target with a radius of "
                f"{radius_m:.3g} m: give port.centre_m in metres, in the axes of the mesh"
            )

    def circle(self, mesh: Mesh) -> DockingRing:
        """What a close camera sees of the port: its ring, or a circle around its centre."""
        wide_m = _SEEN_RADII * mesh.bounding_sphere[1]
        return self.ring or DockingRing(self.centre_m, self.axis, wide_m)


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """The chaser before the port, in the target's axes, which turn with it."""

    range_m: float  # port to port along the axis; ≤ 0: contact
    aside_m: Array  # (3,) the chaser's port off the axis
    turn: Array  # (3,) rotation vector from the aligned attitude, camera frame, rad
    speed_m_s: Array  # (3,) of the chaser's port
    rate: Array  # (3,) of the chaser against the target, camera frame, rad/s
    mass_m: Array  # (3,) its centre of mass from the target's origin
    mass_speed_m_s: Array  # (3,) of it
    closing_m_s: float

    @classmethod
    def of(cls, port: Port, pose: Pose, rates: Array, turning: Array) -> Relative:
        """From a pose.

        Args:
            pose: camera_from_target.
            rates: (6,) the target's angular rate, and the velocity of its origin against the
                camera, both against inertial space, camera frame: as a fused `Estimate` has them.
            turning: (3,) the camera's own rate against inertial space, camera frame.
        """
        target = pose.rotation.T
        spin = target @ rates[:3]

        def at(arm_m: float) -> tuple[Array, Array]:
            """Place and velocity of a point on the boresight."""
            place = target @ (arm_m * _AHEAD - pose.translation_m)
            inertial = target @ (so3.hat(turning) @ (arm_m * _AHEAD) - rates[3:])
            return place, inertial - so3.hat(spin) @ place

        nose, speed = at(port.ahead_m)
        mass, mass_speed = at(-port.behind_m)
        off = nose - port.centre_m
        range_m = float(off @ port.axis)
        turn = so3.log(np.ascontiguousarray(pose.rotation @ port.facing.T))
        return cls(
            range_m, off - range_m * port.axis, turn, speed, turning - rates[:3], mass, mass_speed,
            -float(speed @ port.axis),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Contact:
    """Contact conditions, in the order of the envelope."""

    lateral_m: float
    tilt_rad: float  # of the axes
    roll_rad: float
    closing_m_s: float
    lateral_m_s: float
    across_rad_s: float  # rate across the axis
    about_rad_s: float  # rate about it

    @classmethod
    def of(cls, port: Port, at: Relative) -> Contact:
        """The conditions of a place."""
        slide = at.speed_m_s + at.closing_m_s * port.axis
        return cls(
            float(np.linalg.norm(at.aside_m)), math.hypot(*at.turn[:2]), abs(float(at.turn[2])),
            at.closing_m_s, float(np.linalg.norm(slide)), math.hypot(*at.rate[:2]),
            abs(float(at.rate[2])),
        )  # fmt: skip

    def outside(self, limits: EnvelopeOptions, margin: Contact | None = None) -> str | None:
        """Which condition is outside the envelope, in words; None: all are inside.

        Args:
            margin: by how much each may be worse than it is known.
        """
        worse = margin or Contact(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        angle, rate = math.radians(limits.angle_deg), math.radians(limits.rate_deg_s)
        slowest, fastest = limits.closing_m_s
        checks = (
            ("lateral", self.lateral_m + worse.lateral_m, 0.0, limits.lateral_m),
            ("tilt", self.tilt_rad + worse.tilt_rad, 0.0, angle),
            ("roll", self.roll_rad + worse.roll_rad, 0.0, angle),
            ("closing fast", self.closing_m_s + worse.closing_m_s, -math.inf, fastest),
            ("closing slow", self.closing_m_s - worse.closing_m_s, slowest, math.inf),
            ("lateral speed", self.lateral_m_s + worse.lateral_m_s, 0.0, limits.lateral_m_s),
            ("rate across", self.across_rad_s + worse.across_rad_s, 0.0, rate),
            ("rate about", self.about_rad_s + worse.about_rad_s, 0.0, rate),
        )
        return next((name for name, value, low, high in checks if not low <= value <= high), None)
