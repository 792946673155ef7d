"""Joints: parts of a target that turn about an axis fixed to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array


@dataclass(frozen=True, slots=True, eq=False)
class Hinge:
    """An axis about which some parts of the mesh turn, positive by the right-hand rule."""

    axis: Array  # (3,) unit, target frame
    origin_m: Array  # (3,) a point on the axis, target frame

    def turn(self, angle_rad: float) -> Array:
        """(3, 3) rotation of the parts at an angle."""
        return np.asarray(Rotation.from_rotvec(angle_rad * self.axis).as_matrix())

    def moved(self, points_m: npt.ArrayLike, angle_rad: float) -> Array:
        """Points (N, 3) of the parts, target frame, turned by an angle."""
        points = np.asarray(points_m, dtype=np.float64)
        return (points - self.origin_m) @ self.turn(angle_rad).T + self.origin_m

    def record(self) -> dict[str, Any]:
        """The hinge as model files keep it."""
        return {"axis": self.axis.tolist(), "origin_m": self.origin_m.tolist()}

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Hinge:
        """The hinge of ``record``."""
        axis, origin_m = (np.array(record[k], dtype=np.float64) for k in ("axis", "origin_m"))
        if axis.shape != (3,) or origin_m.shape != (3,):
            raise ValueError("a joint's axis and origin must be of three numbers")
        return cls(axis, origin_m)


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """One degree of freedom: some parts of the mesh turn by the same angle, each about its hinge.

    At the angle 0 the parts are where the mesh has them.
    """

    name: str
    hinges: tuple[Hinge, ...]  # one, or such as those of a pair of doors
    lowest_rad: float
    highest_rad: float
    period_rad: float | None = None  # turns by this change nothing; None: the range has two ends

    def within(self, angle_rad: float) -> float:
        """The angle in the joint's range: wrapped by the period, or held at the nearer end."""
        if self.period_rad is not None:
            return self.lowest_rad + (angle_rad - self.lowest_rad) % self.period_rad
        return min(max(angle_rad, self.lowest_rad), self.highest_rad)

    def apart(self, angle_rad: float, other_rad: float) -> float:
        """Signed difference of two angles, the shorter way where turns repeat."""
        difference = angle_rad - other_rad
        if self.period_rad is not None:
            half = 0.5 * self.period_rad
            difference = (difference + half) % self.period_rad - half
        return difference

    def configurations(self, step_rad: float) -> Array:
        """(K,) angles that cover the range, at most a step apart."""
        span = self.highest_rad - self.lowest_rad
        if self.period_rad is not None:
            count = max(1, math.ceil(self.period_rad / step_rad - 1e-9))
            return np.asarray(self.lowest_rad + self.period_rad / count * np.arange(count))
        # Each end lies half a step beyond the outermost configurations.
        count = max(1, math.ceil(span / step_rad - 1e-9))
        return np.asarray(self.lowest_rad + span / count * (np.arange(count) + 0.5))

    def record(self) -> dict[str, Any]:
        """The joint as model files keep it."""
        return {
            "name": self.name,
            **self.hinges[0].record(),
            "others": [hinge.record() for hinge in self.hinges[1:]],
            "limits_rad": [self.lowest_rad, self.highest_rad],
            "period_rad": self.period_rad,
        }

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Joint:
        """The joint of ``record``."""
        hinges = tuple(Hinge.of_record(one) for one in (record, *record.get("others", [])))
        low, high = record["limits_rad"]
        return cls(record["name"], hinges, low, high, record["period_rad"])


def hinges_of(joints: Sequence[Joint]) -> list[tuple[int, Hinge]]:
    """Each hinge with the number of its joint, in the order of the mesh's parts: 1, 2 and so on."""
    return [(k, hinge) for k, joint in enumerate(joints) for hinge in joint.hinges]


def apart(joints: Sequence[Joint], angles_rad: Array, others_rad: Array) -> Array:
    """(J,) signed differences of two states of some joints, see ``Joint.apart``."""
    pairs = zip(joints, angles_rad, others_rad, strict=True)
    return np.array([joint.apart(float(a), float(b)) for joint, a, b in pairs])


def within(joints: Sequence[Joint], angles_rad: Array) -> Array:
    """(J,) the angles in the ranges of some joints, see ``Joint.within``."""
    return np.array([j.within(float(a)) for j, a in zip(joints, angles_rad, strict=True)])
