"""A model's look-alikes in plain words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, angle_between

_NAMED = 3  # likest turns that are named. Source: by construction
_SAME_RAD = np.deg2rad(2.0)  # an exact symmetry, as it is found. Source: by construction
_TOLD = 0.8  # share of the surface; less is not called nearly symmetric. Source: by construction


def look_alike_words(turns: Array, alike: Array, symmetries: Sequence[Symmetry] = ()) -> str | None:
    """Which turns leave most of the surface where it was; None where none does.

    Args:
        turns: (K, 3, 3) of near-symmetries.
        alike: (K,) share of the surface that each leaves where it was.
        symmetries: turns that leave all of it; they are left out.
    """
    here = Pose.identity()

    def differs(turn: Array) -> bool:
        return bool(angle_between(Pose(turn, np.zeros(3)), here, symmetries) > _SAME_RAD)

    order = np.argsort(-alike, kind="stable")
    told = [k for k in order if alike[k] >= _TOLD and np.linalg.det(turns[k]) > 0.0]
    told = [k for k in told if differs(turns[k])]
    if not told:
        return None
    # A turn and the turn back are one.
    shares: dict[str, float] = {}
    for k in told:
        shares.setdefault(_turn_words(turns[k]), 100.0 * float(alike[k]))
    named = [
        f"{words} ({share:.0f} % of the surface the same)"
        for words, share in list(shares.items())[:_NAMED]
    ]
    more = f" and {len(shares) - _NAMED} more" if len(shares) > _NAMED else ""
    return f"looks nearly the same turned by {', '.join(named)}{more}"


def _turn_words(turn: Array) -> str:
    vector = Rotation.from_matrix(turn).as_rotvec()
    angle = float(np.linalg.norm(vector))
    axis = vector / angle
    axis *= np.sign(axis[np.argmax(np.abs(axis))])
    for name, along in zip("xyz", axis, strict=True):
        if along > np.cos(np.deg2rad(2.0)):
            return f"{np.rad2deg(angle):.0f}° about {name}"
    return f"{np.rad2deg(angle):.0f}° about ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"
