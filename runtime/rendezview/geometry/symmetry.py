"""Poses that look alike because the target is symmetric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose, rotation_angle

# rad; turns closer than this are the same, because angles in files are rounded.
_SAME_RAD = 5e-3  # Source: by construction
# Turns; a target with steps of 2° has so many, an angle that divides no full turn has more.
_MOST_TURNS = 180  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Symmetry:
    """A turn about an axis through the origin of the target frame that changes nothing.

    Discrete: the turn by ``angle_rad`` and its multiples. Continuous: any turn.
    """

    kind: Literal["discrete", "continuous"]
    axis: Array  # (3,) unit
    angle_rad: float | None  # None when continuous


def nearest_alike(estimate: Pose, truth: Pose, symmetries: Sequence[Symmetry]) -> Pose:
    """Of all poses alike to an estimate, the one whose attitude is nearest to the truth.

    The axes pass through the target's origin, so the translation stays. Discrete turns
    are combined with each other and with a continuous axis; two continuous axes, or one
    that a discrete turn moves, make a ball, of which any attitude is right.

    Raises:
        ValueError: discrete turns that never come round (an angle is wrong).
    """
    turns = discrete_turns(symmetries)
    axes = [s.axis / np.linalg.norm(s.axis) for s in symmetries if s.kind == "continuous"]
    if not axes:
        alike = [estimate.rotation @ turn for turn in turns]
    else:
        moved = [turn @ axes[0] for turn in turns] + axes
        if any(np.linalg.norm(np.cross(axis, axes[0])) > _SAME_RAD for axis in moved):
            return Pose(truth.rotation, estimate.translation_m)
        alike = [_spun(estimate.rotation @ turn, truth.rotation, axes[0]) for turn in turns]
    best = min(alike, key=lambda rotation: rotation_angle(rotation @ truth.rotation.T))
    return Pose(best, estimate.translation_m)


def angle_between(a: Pose, b: Pose, symmetries: Sequence[Symmetry]) -> float:
    """Least angle between two attitudes of a symmetric target, radians in [0, π]."""
    if not symmetries:
        return a.angle_to(b)
    return nearest_alike(a, b, symmetries).angle_to(b)


def discrete_turns(symmetries: Sequence[Symmetry]) -> list[Array]:
    """All turns (3, 3) that the discrete symmetries generate, the identity first.

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


def _spun(rotation: Array, truth: Array, axis: Array) -> Array:
    """``rotation`` after the turn about ``axis`` (3,) of the target that is best.

    The quaternion of ``truthᵀ rotation spin(φ)`` has the real part ``w cos φ/2 − (v·a)
    sin φ/2``, greatest at ``φ/2 = atan2(−v·a, w)``.
    """
    x, y, z, w = Rotation.from_matrix(truth.T @ rotation).as_quat()
    half = np.arctan2(-(np.array([x, y, z]) @ axis), w)
    return np.asarray(rotation @ Rotation.from_rotvec(2.0 * half * axis).as_matrix())
