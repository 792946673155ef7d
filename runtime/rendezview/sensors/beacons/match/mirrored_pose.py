"""The second pose of reflectors in a plane, which shows nearly the same picture from far away."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern

Ints = npt.NDArray[np.int64]


def mirror(pose: Pose, pattern: ReflectorPattern, which: Ints) -> Pose:
    """The pose whose weak-perspective picture of reflectors in a plane is the same.

    Depths about the middle change their sign: the plane's normal is mirrored about the line of
    sight. Least squares from there finds the second minimum, if there is one.
    """
    middle, normal = _plane(pattern, tuple(which.tolist()))
    place = pose.apply(middle)
    turned, sight = pose.rotation @ normal, place / math.sqrt(float(place @ place))
    # (I − 2 s sᵀ) R (I − 2 n nᵀ), s the line of sight
    half = pose.rotation - 2.0 * turned[:, None] * normal
    rotation = half - 2.0 * sight[:, None] * (sight @ half)
    return Pose.unchecked(rotation, place - rotation @ middle)


@lru_cache(maxsize=64)
def _plane(pattern: ReflectorPattern, which: tuple[int, ...]) -> tuple[Array, Array]:
    """Middle of some reflectors and normal of the plane through them, target frame."""
    points = pattern.positions_m[list(which)]
    middle = points.mean(axis=0)
    return middle, np.ascontiguousarray(np.linalg.svd(points - middle)[2][2])
