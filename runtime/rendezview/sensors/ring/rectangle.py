"""Attitude from a rectangle of unknown size, its scale from one laser range (Zhai et al., eq. 1–3).

The paper's camera looks along x; here rays are (x, y, 1) of this package's camera frame, which
changes nothing but the order of the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Beam:
    """A laser ranger's beam in the camera frame; as default the camera's boresight."""

    origin_m: Array = field(default_factory=lambda: np.zeros(3))  # (3,)
    direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # (3,) unit

    def end(self, range_m: float) -> Array:
        """(3,) where an echo of this range is from, camera frame."""
        return np.asarray(self.origin_m + range_m * self.direction)


@dataclass(frozen=True, slots=True, eq=False)
class RectangleSight:
    """A rectangle as one frame shows it."""

    rotation: Array  # (3, 3) camera from rectangle frame
    depth_ratios: Array  # (4,) of the corners, the first 1 (1, k1, k2, k4 of the paper)
    skew_rad: float  # how far the sides were from a right angle before they were made one
    rays: Array  # (4, 3) of the corners, z = 1


def rectangle_attitude(camera: Camera, corners_px: npt.ArrayLike) -> RectangleSight | None:
    """Attitude of a rectangle of unknown size; None where three corners lie on a line.

    Its frame, as in the paper: 1 → 2 along -y, 1 → 3 along -z, 4 opposite 1; x = y × z. The
    sense of rotation of the given corners decides whether the x axis points towards or from the
    camera; the user gives the docking side.

    Args:
        camera: lens distortion included.
        corners_px: (4, 2) in the order 1, 2, 3, 4.
    """
    rays = camera.rays(corners_px)
    if rays.shape != (4, 3) or not np.isfinite(rays).all():
        raise ValueError("corners_px must be (4, 2), visible to the camera")
    q1, q2, q3, q4 = rays
    # x1 q1 - x2 q2 - x3 q3 + x4 q4 = 0: linear in k1 = x2/x1, k2 = x3/x1, k4 = x4/x1.
    system = np.column_stack([q2, q3, -q4])
    if abs(np.linalg.det(system)) < 1e-12:
        return None
    k1, k2, k4 = np.linalg.solve(system, q1)
    if min(k1, k2, k4) <= 0.0:
        return None
    r2, r3 = q1 - k1 * q2, q1 - k2 * q3  # eq. 1, 2
    r2, r3 = r2 / np.linalg.norm(r2), r3 / np.linalg.norm(r3)
    skew = float(np.arcsin(np.clip(r2 @ r3, -1.0, 1.0)))
    # Noise leaves them not quite square: each gives way by half, then eq. 3.
    total, difference = r2 + r3, r2 - r3
    total /= np.linalg.norm(total)
    difference /= np.linalg.norm(difference)
    r2, r3 = (total + difference) / np.sqrt(2.0), (total - difference) / np.sqrt(2.0)
    rotation = np.column_stack([np.cross(r2, r3), r2, r3])
    return RectangleSight(rotation, np.array([1.0, k1, k2, k4]), skew, rays)


def rectangle_pose(
    camera: Camera,
    corners_px: npt.ArrayLike,
    range_m: float,
    beam: Beam | None = None,
) -> tuple[Pose, float] | None:
    """Pose of the rectangle's middle and the skew (rad) of its sides; None where there is none.

    Args:
        camera: lens distortion included.
        corners_px: (4, 2); see `rectangle_attitude`.
        range_m: along ``beam`` to the plane of the rectangle.
        beam: of the laser; None: the boresight.
    """
    sight = rectangle_attitude(camera, corners_px)
    if sight is None:
        return None
    normal = sight.rotation[:, 0]
    across = float(normal @ sight.rays[0])
    if abs(across) < 1e-9:
        return None
    first = float(normal @ (beam or Beam()).end(range_m)) / across
    corners = first * sight.depth_ratios[:, None] * sight.rays
    if first <= 0.0:
        return None
    return Pose(sight.rotation, corners.mean(axis=0)), sight.skew_rad
