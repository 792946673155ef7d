"""Poses that look alike because the target is symmetric.

A turn S about an axis through the point c maps p to ``S p + c − S c``. The pose alike to (R, t) is
``(R S, t + R (c − S c))``: the point c stays where it is. The axes of one body share such a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose, rotation_angle

# rad; turns closer than this are the same, because angles in files are rounded.
_SAME_RAD = 5e-3  # Source: by construction
# Turns; a target with steps of 2° has so many, an angle that divides no full turn has more.
_MOST_TURNS = 180  # Source: by construction
# By so much axes may miss each other, because points in files are rounded: a share of the
# largest distance of a point from the origin, and metres beside it.
_MISS, _MISS_M = 0.01, 1e-3  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Symmetry:
    """A turn about an axis of the target that changes nothing.

    Discrete: the turn by ``angle_rad`` and its multiples. Continuous: any turn.
    """

    kind: Literal["discrete", "continuous"]
    axis: Array  # (3,) unit
    angle_rad: float | None  # None when continuous
    # (3,) any point of the axis, target frame; default: the origin
    point_m: Array = field(default_factory=lambda: np.zeros(3))

    def record(self) -> dict[str, Any]:
        """As JSON; without ``point_m`` if that is the origin."""
        record = {
            "kind": self.kind,
            "axis": np.asarray(self.axis).tolist(),
            "angle_rad": self.angle_rad,
        }
        if np.any(self.point_m):
            record["point_m"] = np.asarray(self.point_m).tolist()
        return record

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Symmetry:
        """The inverse of `record`.

        Raises:
            ValueError: axis or point are no three numbers.
        """
        axis = np.array(record["axis"], dtype=np.float64).reshape(3)
        point_m = np.array(record.get("point_m", [0.0, 0.0, 0.0]), dtype=np.float64).reshape(3)
        return cls(record["kind"], axis, record["angle_rad"], point_m)


def nearest_alike(estimate: Pose, truth: Pose, symmetries: Sequence[Symmetry]) -> Pose:
    """Of all poses alike to an estimate, the one whose attitude is nearest to the truth.

    The common point of the axes stays where it is; the target's origin moves if it lies beside
    an axis. Discrete turns are combined with each other and with a continuous axis; two
    continuous axes, or one that a discrete turn moves, make a ball, of which any attitude is right.

    Raises:
        ValueError: discrete turns that never come round (an angle is wrong), or axes without a
            common point.
    """
    if not symmetries:
        return estimate
    group = _group(tuple(symmetries))
    if group.ball:
        rotation = truth.rotation
    elif group.axis is None:
        # The least angle has the largest trace, Σ Aᵢⱼ Sⱼᵢ for A = truthᵀ estimate and a turn S.
        traces = group.transposed @ (truth.rotation.T @ estimate.rotation).ravel()
        rotation = estimate.rotation @ group.turns[int(np.argmax(traces))]
    else:
        turned = (estimate.rotation @ turn for turn in group.turns)
        alike = [_spun(rotation, truth.rotation, group.axis) for rotation in turned]
        rotation = min(alike, key=lambda rotation: rotation_angle(rotation @ truth.rotation.T))
    if not group.centre_m.any():
        return Pose(rotation, estimate.translation_m)
    return Pose(rotation, estimate.apply(group.centre_m) - rotation @ group.centre_m)


def angle_between(a: Pose, b: Pose, symmetries: Sequence[Symmetry]) -> float:
    """Least angle between two attitudes of a symmetric target, radians in [0, π]."""
    if not symmetries:
        return a.angle_to(b)
    return nearest_alike(a, b, symmetries).angle_to(b)


def discrete_turns(symmetries: Sequence[Symmetry]) -> list[Array]:
    """All turns (3, 3) that the discrete symmetries generate, the identity first.

    They are about the point of ``common_point``.

    Raises:
        ValueError: more than a target can have: an angle divides no whole number of turns.
    """
    generators = []
    for symmetry in symmetries:
        if symmetry.kind == "discrete":
            if symmetry.angle_rad is None:
                raise ValueError("a discrete symmetry needs its angle_rad")
            generators.append(Rotation.from_rotvec(symmetry.axis * symmetry.angle_rad).as_matrix())
    turns = [np.eye(3)]
    for turn in turns:  # grows while it is walked
        for generator in generators:
            candidate = np.asarray(generator @ turn)
            known = np.stack(turns)
            # ‖A − B‖ = 2 √2 sin(angle / 2)
            apart = np.linalg.norm(known - candidate, axis=(1, 2)).min()
            if apart > np.sqrt(2.0) * _SAME_RAD:
                turns.append(candidate)
        if len(turns) > _MOST_TURNS:
            angles = [s.angle_rad for s in symmetries if s.kind == "discrete"]
            raise ValueError(f"these symmetries never come round: angle_rad {angles}")
    return turns


def common_point(symmetries: Sequence[Symmetry], miss_m: float | None = None) -> Array:
    """(3,) the point through which all axes pass, target frame; of one axis its given point.

    Args:
        symmetries: of one target; none: the origin.
        miss_m: by so much an axis may pass beside the point; ``None``: 1 mm, and 1 % of the
            largest distance of a given point from the origin.

    Raises:
        ValueError: the axes have no common point, as those of a body have.
    """
    if not symmetries:
        return np.zeros(3)
    points = np.array([symmetry.point_m for symmetry in symmetries], dtype=np.float64)
    if miss_m is None:
        miss_m = _MISS_M + _MISS * float(np.linalg.norm(points, axis=1).max())
    # Least squares of the distances (I − a aᵀ)(c − p), from the mean of the points.
    middle = points.mean(axis=0)
    axes = np.array([s.axis / np.linalg.norm(s.axis) for s in symmetries])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    aside = np.einsum("kij,kj->i", across, points - middle)
    point = middle + np.linalg.pinv(across.sum(axis=0), rcond=1e-9) @ aside
    missed = np.linalg.norm(np.einsum("kij,kj->ki", across, points - point), axis=1)
    if missed.max() > miss_m:
        raise ValueError(
            f"these axes have no common point, they miss it by {missed.max():.3g} m: "
            f"point_m {points.tolist()}"
        )
    return np.asarray(point)


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """All turns of a target's symmetries."""

    turns: tuple[Array, ...]  # (3, 3) each, the identity first
    transposed: Array  # (N, 9) of them
    axis: Array | None  # (3,) unit, of any turn
    ball: bool  # any attitude looks alike
    centre_m: Array  # (3,) stays in place


@lru_cache(maxsize=64)  # a search compares hundreds of poses of one target
def _group(symmetries: tuple[Symmetry, ...]) -> _Group:
    turns = discrete_turns(symmetries)
    axes = [s.axis / np.linalg.norm(s.axis) for s in symmetries if s.kind == "continuous"]
    ball = False
    if axes:
        moved = [turn @ axes[0] for turn in turns] + axes
        ball = any(np.linalg.norm(np.cross(axis, axes[0])) > _SAME_RAD for axis in moved)
    axis = axes[0] if axes else None
    transposed = np.array(turns).transpose(0, 2, 1).reshape(-1, 9)
    return _Group(tuple(turns), transposed, axis, ball, common_point(symmetries))


def _spun(rotation: Array, truth: Array, axis: Array) -> Array:
    """``rotation`` after the turn about ``axis`` (3,) of the target that is best.

    The quaternion of ``truthᵀ rotation spin(φ)`` has the real part ``w cos φ/2 − (v·a)
    sin φ/2``, greatest at ``φ/2 = atan2(−v·a, w)``.
    """
    x, y, z, w = Rotation.from_matrix(truth.T @ rotation).as_quat()
    half = np.arctan2(-(np.array([x, y, z]) @ axis), w)
    return np.asarray(rotation @ Rotation.from_rotvec(2.0 * half * axis).as_matrix())
