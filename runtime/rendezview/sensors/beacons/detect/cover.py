"""Spots that are partly hidden: narrower than their neighbours, across the edge that hides them.

An edge that hides a part of a disc moves the middle of what is left, along its narrow axis. The
elongation beside that of its neighbours tells by how much, not which way.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.spots import LONG_X, LONG_XY, SIGMA, SIZE

Ints = npt.NDArray[np.int64]

# × elongation of the disc, × extent: by how much, one σ an axis, the middle has moved. Of 20 and
# 35 % hidden it moves by 1.1 to 1.6 times √2 of these. Source: experiment reflector-nees --kind 20
_SHIFT = 1.6
# of a spot's own elongation a Gaussian window of its size shows so much. Source: by construction
_WINDOWED = 0.5
# × the disc's share: σ of an elongation beside its neighbours', but for the noise.
# Source: experiment reflector-nees --kind retro
_ROUND_SIGMA = 0.007
# σ of an elongation over that of the place, in sizes; simulated 0.8
_NOISE = 0.8  # Source: experiment reflector-nees --kind retro
_SURE = 2.7  # σ; clean spots exceed it once in 200. Source: reflector-nees --kind retro


def covered_px(
    rows: Array, pattern: ReflectorPattern, which: Ints, pose: Pose, blur_px: float
) -> Array:
    """(K,) σ, px, of each spot's place by what may hide a part of it; 0 where nothing does.

    Args:
        rows: (K, 23) of the spot table, three or more.
        pattern: the reflectors; which: (K,) whose spots these are.
        pose: of the target, near enough for the shape of its discs.
        blur_px: σ of the optics and a pixel's width together.
    """
    sizes = rows[:, SIZE]
    # Of a spot that is mostly blur, little of the shape is the disc's.
    extent = np.sqrt(np.maximum(sizes**2 - blur_px**2, (0.1 * sizes) ** 2))
    share = (extent / sizes) ** 2
    long = rows[:, [LONG_X, LONG_XY]] - share[:, None] * _elongation(pattern, which, pose)
    known = np.isfinite(long).all(axis=1)
    if np.count_nonzero(known) < 3:
        return np.zeros(len(rows))
    long -= middle(long[known])
    off = np.where(known, np.hypot(*long.T), 0.0)
    noise = middle(rows[:, SIGMA]) / sizes  # a strange spot's own may be larger already
    doubt = np.hypot(_ROUND_SIGMA * share, _NOISE * noise)
    return np.where(off > _SURE * doubt, _SHIFT * extent * off / share, 0.0)


def middle(values: Array) -> Array:
    """Median along the first axis; of so few numbers `np.median` takes ten times as long."""
    rising, count = np.sort(values, axis=0), len(values)
    return np.asarray(0.5 * (rising[(count - 1) // 2] + rising[count // 2]))


def _elongation(pattern: ReflectorPattern, which: Ints, pose: Pose) -> Array:
    """(K, 2) of discs in the picture, without blur, as a window of their size shows it."""
    places, normals = pose.apply(pattern.positions_m[which]), pattern.normals[which]
    at, turned = places[:, :2] / places[:, 2:], normals @ pose.rotation.T
    lean = turned[:, :2] - turned[:, 2:] * at  # of the disc's plane I − n nᵀ under the projection
    xx, yy = (1.0 + at**2 - lean**2).T
    xy = at[:, 0] * at[:, 1] - lean[:, 0] * lean[:, 1]
    return np.asarray(_WINDOWED * np.column_stack([xx - yy, 2.0 * xy]) / (xx + yy)[:, None])
