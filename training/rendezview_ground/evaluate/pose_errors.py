"""Errors of an estimated pose.

All measures are magnitudes. Rotation and translation refer to ``camera_from_target``. View
direction, roll, range and bearing refer to the *view centre*, a point of the target that the caller
gives (default: its origin).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Array, Pose, minimal_rotation, rotation_angle
from rendezview.geometry.symmetry import Symmetry, nearest_alike
from rendezview.sensors.appearance.model.signature import twist

# SPEED+ counts errors below the accuracy of its truth as 0. Source: Park et al. 2023, calibration
SPEED_PLUS_ROTATION_RAD = float(np.deg2rad(0.169))  # rad
SPEED_PLUS_TRANSLATION = 2.173e-3  # of the range

_BORESIGHT = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of one estimate."""

    rotation_rad: float  # angle of the rotation between the two attitudes
    direction_rad: float  # of the camera as seen from the view centre
    roll_rad: float  # about the line of sight
    translation_m: float  # of the target's origin
    range_fraction: float  # of the view centre, as a part of its true range
    bearing_rad: float  # of the view centre as seen from the camera
    speed_rotation: float  # SPEED's e_q, rad
    speed_translation: float  # SPEED's e_t, error of the origin over its true range
    translation_fraction: float  # the same, without the thresholds of SPEED+

    @property
    def speed_score(self) -> float:
        """SPEED's score of one image, ``e_q + e_t``."""
        return self.speed_rotation + self.speed_translation


def pose_errors(
    truth: Pose,
    estimate: Pose,
    *,
    symmetries: Sequence[Symmetry] = (),
    centre_m: npt.ArrayLike | None = None,
    speed_plus: bool = False,
) -> PoseErrors:
    """Errors of one estimated ``camera_from_target``.

    View direction and roll are swing and twist of the attitude error of a camera turned towards the
    view centre. A pure bearing error changes neither.

    Args:
        truth: camera_from_target.
        estimate: the same, estimated.
        symmetries: of the target; the equivalent pose with the least angle to the truth is used.
        centre_m: (3,) view centre, target frame; None: the target's origin.
        speed_plus: apply the thresholds of SPEED+, below which SPEED's terms are 0.

    Raises:
        ValueError: the true view centre or the true origin lies in the camera's centre.
    """
    if symmetries:
        estimate = nearest_alike(estimate, truth, symmetries)
    centre = np.zeros(3) if centre_m is None else np.asarray(centre_m, dtype=np.float64)
    true_centre, centre_found = truth.apply(centre), estimate.apply(centre)
    true_range_m = float(np.linalg.norm(true_centre))
    origin_range_m = float(np.linalg.norm(truth.translation_m))
    if not (true_range_m > 0.0 and origin_range_m > 0.0):
        raise ValueError("the true pose puts the target into the camera's own centre")
    range_m = float(np.linalg.norm(centre_found))
    rotation_rad = rotation_angle(estimate.rotation @ truth.rotation.T)
    direction_rad = roll_rad = bearing_rad = float(np.pi)
    if range_m > 0.0:  # else these errors are undefined: the largest possible values
        sight, true_sight = centre_found / range_m, true_centre / true_range_m
        bearing_rad = float(angle_between(sight, true_sight))
        attitude, true_attitude = _centred(estimate, sight), _centred(truth, true_sight)
        direction_rad = float(angle_between(attitude[2], true_attitude[2]))
        roll_rad = abs(float(twist(attitude, true_attitude)))
    translation_m = float(np.linalg.norm(estimate.translation_m - truth.translation_m))
    speed_rotation, speed_translation = speed_terms(
        rotation_rad, translation_m / origin_range_m, speed_plus=speed_plus
    )
    return PoseErrors(
        rotation_rad=rotation_rad,
        direction_rad=direction_rad,
        roll_rad=roll_rad,
        translation_m=translation_m,
        range_fraction=abs(range_m / true_range_m - 1.0),
        bearing_rad=bearing_rad,
        speed_rotation=speed_rotation,
        speed_translation=speed_translation,
        translation_fraction=translation_m / origin_range_m,
    )


def speed_terms(
    rotation_rad: float, translation_fraction: float, *, speed_plus: bool = False
) -> tuple[float, float]:
    """The two terms of SPEED's score, e_q and e_t, optionally with the thresholds of SPEED+.

    Args:
        rotation_rad: angle between the attitudes.
        translation_fraction: error of the origin's position over its true range.
        speed_plus: a term below its threshold counts as 0.
    """
    if speed_plus:
        if rotation_rad < SPEED_PLUS_ROTATION_RAD:
            rotation_rad = 0.0
        if translation_fraction < SPEED_PLUS_TRANSLATION:
            translation_fraction = 0.0
    return rotation_rad, translation_fraction


def _centred(pose: Pose, sight: Array) -> Array:
    """(3, 3) attitude of a camera turned so that its boresight is the line of sight (3,)."""
    return np.asarray(minimal_rotation(sight, _BORESIGHT) @ pose.rotation)
