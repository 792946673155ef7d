"""Starting poses of the search: rotations about a pose, and its half turns."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.model.contours import NO_POINT
from rendezview.sensors.appearance.model.view_model import ViewModel

# rad; alignment converges from about half of it. Source: by hand, seeds of docs/notes/refinement.md
_LARGEST_STEP_RAD = np.deg2rad(20.0)
# Of ``rotated_about``: the pose itself and its turns about the axes.
_AXES = 7  # Source: by construction
_STEP, _DIAGONAL_STEP = 0.8, 0.7  # of the error, and of the step for each part of a diagonal


def rotated_about(pose: Pose, centre_m: Array, error_rad: float) -> tuple[Array, Array]:
    """A pose and its rotations about the view centre: six along the axes, eight diagonal ones.

    Returns:
        Rotations (15, 3, 3) camera_from_target, the pose's own first, and the view centre (15, 3),
        camera frame.
    """
    step = min(error_rad, _LARGEST_STEP_RAD) * _STEP
    axes = [sign * step * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    diagonals = [
        step * _DIAGONAL_STEP * np.array([a, b, c])
        for a in (1, -1)
        for b in (1, -1)
        for c in (1, -1)
    ]
    turns = Rotation.from_rotvec([np.zeros(3), *axes, *diagonals]).as_matrix()
    return turns @ pose.rotation, np.tile(pose.apply(centre_m), (len(turns), 1))


def rotated_about_axes(pose: Pose, centre_m: Array, error_rad: float) -> list[Pose]:
    """The first seven of ``rotated_about``: the pose and its turns about the camera's axes."""
    rotations, centres = rotated_about(pose, centre_m, error_rad)
    return list(map(Pose, rotations[:_AXES], (centres - rotations @ centre_m)[:_AXES]))


def half_turns(model: ViewModel) -> Array:
    """(3, 3, 3) rotations by 180° about the principal axes of the model's contour points."""
    contours = model.contours
    if contours is None:
        raise ValueError("the model has no contour points")
    shape = (-1, contours.point.shape[-1])
    _, axes = np.linalg.eigh(second_moments(contours.point.reshape(shape), contours.kind.ravel()))
    return np.array([2.0 * np.outer(axis, axis) - np.eye(3) for axis in axes.T])


def rotated_by(pose: Pose, turns: Array, centre_m: Array) -> list[Pose]:
    """A pose with the target rotated by each of some turns (K, 3, 3) about the view centre."""
    rotations = pose.rotation @ turns
    return list(map(Pose, rotations, pose.apply(centre_m) - rotations @ centre_m))


def second_moments(points: npt.NDArray[np.int16], kinds: npt.NDArray[np.uint8]) -> Array:
    """(3, 3) Σ p pᵀ of the points (N, 3) int16 that are any; whole numbers, so it is exact."""
    found = points[kinds != NO_POINT].astype(np.float64)
    return np.asarray(found.T @ found)
