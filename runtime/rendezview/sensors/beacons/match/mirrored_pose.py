"""The second pose of reflectors in a plane, which shows nearly the same picture from far away."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern

Ints = npt.NDArray[np.int64]


def mirror(pose: Pose, pattern: ReflectorPattern, which: Ints) -> Pose:
    """The pose whose weak-perspective picture of reflectors in a plane is the same.

    Depths about the middle change their sign: the plane's normal is mirrored about the line of
    sight. Least squares from there finds the second minimum, if there is one.
    """
    middle, normal = _plane(pattern, tuple(which.tolist()))
    rotation, translation = np.empty((3, 3)), np.empty(3)
    mirror_into(pose.rotation, pose.translation_m, middle, normal, rotation, translation)
    return Pose.unchecked(rotation, translation)


@lru_cache(maxsize=64)
def _plane(pattern: ReflectorPattern, which: tuple[int, ...]) -> tuple[Array, Array]:
    """Middle of some reflectors and normal of the plane through them, target frame."""
    points = pattern.positions_m[list(which)]
    middle = points.mean(axis=0)
    return middle, np.ascontiguousarray(np.linalg.svd(points - middle)[2][2])


@njit(cache=True, nogil=True, error_model="numpy")
def mirror_into(
    rotation: Array, translation: Array, middle: Array, normal: Array, out: Array, moved: Array
) -> None:
    """Fill the rotation (I − 2 s sᵀ) R (I − 2 n nᵀ), s the middle's line of sight, and its place.

    Args:
        rotation, translation: of the pose.
        middle, normal: (3,) of a plane, target frame.
    """
    sight, turned = np.empty(3), np.empty(3)
    for i in range(3):
        sight[i], turned[i] = translation[i], 0.0
        for j in range(3):
            sight[i] += rotation[i, j] * middle[j]
            turned[i] += rotation[i, j] * normal[j]
    far = math.sqrt(sight[0] ** 2 + sight[1] ** 2 + sight[2] ** 2)
    for i in range(3):
        moved[i] = sight[i]
        sight[i] /= far
    along = sight[0] * turned[0] + sight[1] * turned[1] + sight[2] * turned[2]
    for j in range(3):
        row = sight[0] * rotation[0, j] + sight[1] * rotation[1, j] + sight[2] * rotation[2, j]
        row -= 2.0 * along * normal[j]
        for i in range(3):
            out[i, j] = rotation[i, j] - 2.0 * turned[i] * normal[j] - 2.0 * sight[i] * row
            moved[i] -= out[i, j] * middle[j]
