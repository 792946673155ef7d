"""Yaw, pitch and roll as the paper writes them; angles appear at the edge only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Cosine of the pitch below which yaw and roll are one angle.
_GIMBAL = 1e-7  # Source: by construction, rounding


class YawPitchRoll(NamedTuple):
    """ψ, θ and φ of Welch et al., eq. 3, radians: rotations about z, then y, then x."""

    yaw: float
    pitch: float
    roll: float


def yaw_pitch_roll(rotation: npt.ArrayLike) -> YawPitchRoll:
    """The angles of a (3, 3) rotation ``rig_from_target`` (eq. 3); pitch in [−π/2, π/2].

    At a pitch of ±90° only yaw ∓ roll is determined: roll is then given as 0.
    """
    r = np.asarray(rotation, dtype=np.float64)
    cosine = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = float(np.arctan2(-r[2, 0], cosine))
    if cosine < _GIMBAL:
        return YawPitchRoll(float(np.arctan2(-r[0, 1], r[1, 1])), pitch, 0.0)
    return YawPitchRoll(
        float(np.arctan2(r[1, 0], r[0, 0])), pitch, float(np.arctan2(r[2, 1], r[2, 2]))
    )


def rotation_of(yaw: float, pitch: float, roll: float) -> Array:
    """Eq. 3a–c as a matrix: ``p_fixed = rotation @ p_body + (x_cm, y_cm, z_cm)``."""
    cy, sy = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    return np.array(
        [
            [cp * cy, -cr * sy + sr * sp * cy, sr * sy + cr * sp * cy],
            [cp * sy, cr * cy + sr * sp * sy, -sr * cy + cr * sp * sy],
            [-sp, sr * cp, cr * cp],
        ]
    )
