"""The size of a ring from the ellipses of a whole pass, with its covariance.

Zhai et al. solve each frame for itself. Here the rectangle's sides, the ring's radius R, its
distance D_f and the offset of its axis from the rectangle's middle are the same in every frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.ring.rectangle import rectangle_pose
from rendezview.sensors.ring.ring_size import RingSight
from rendezview.sensors.ring.size_circles import COMMON, FAR, FREEDOM, Ellipses

LEAST_FRAMES = 3  # as for a circle through points. Source: by construction
_ROUNDS = 4  # of leaving out frames, and of a distance and its weights. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class PassSize:
    """A ring as a whole pass measures it, in the rectangle's frame."""

    radius_m: float
    distance_m: float  # D_f, of the ring's plane along x
    offset_m: Array  # (2,) y, z of the ring's axis from the rectangle's middle
    sides_m: Array  # (2,) of the rectangle along y and z
    covariance: Array  # (4, 4) m² of radius, distance and offset
    used: tuple[int, ...]  # numbers of the sights that fit
    chi2: float
    freedom: int


def ring_size_of_pass(
    camera: Camera, sights: Sequence[RingSight], common_px: float = 0.0, along_px: float = 0.0
) -> PassSize | None:
    """R, D_f and the axis' offset from all frames of a pass; None where too few frames fit.

    A frame whose 14 numbers do not fit the others is left out. The offset has a prior of half the
    rectangle's sides (one σ), which decides where all frames look from one direction.

    Args:
        camera: of all frames, without distortion.
        sights: what each frame measured.
        common_px: σ of an error of the ring's semi-axes that all frames share: a model of edges is
            wrong by the same in all of them, so more frames do not lessen it.
        along_px: σ of a shift of the ring along its axis that all pictures share: of a rim that
            shows its wall.
    """
    ellipses = Ellipses(camera, [[sight] for sight in sights])
    which, numbers = np.arange(len(ellipses)), np.zeros(COMMON)
    numbers[4:] = np.median(ellipses.start[:, 5:7], axis=0) if len(which) else 0.0
    for _ in range(_ROUNDS):
        if len(which) < LEAST_FRAMES:
            return None
        prior = np.zeros(COMMON)
        prior[2:4] = (0.5 * numbers[4:]) ** -2.0
        numbers, covariance, chi2 = ellipses.circle(float(numbers[1]), which, prior)
        misfits = ellipses.misfits(numbers, np.zeros((COMMON, COMMON)))[which]
        fits = misfits < FAR
        # A wrong frame spoils its neighbours: those far worse than the limit go first.
        which = which[fits | (misfits < 0.1 * misfits.max())]
    if not (fits.all() and numbers[0] > 0.0):
        return None
    used = tuple(int(k) for k in ellipses.index[which, 0])
    freedom = FREEDOM * len(used) - COMMON
    covariance = covariance[:4, :4] * max(1.0, chi2 / freedom)  # frames that scatter more
    across_m, along_m = _pixel(camera, [sights[k] for k in used], numbers)
    covariance[0, 0] += (common_px * across_m) ** 2
    covariance[1, 1] += (along_px * along_m) ** 2
    radius_m, distance_m = numbers[:2].tolist()
    return PassSize(
        radius_m, distance_m, numbers[2:4], numbers[4:], covariance, used, chi2, freedom
    )


def _pixel(camera: Camera, sights: list[RingSight], numbers: Array) -> tuple[float, float]:
    """How long a pixel is at the ring, across the line of sight and along the ring's axis, m."""
    found = [rectangle_pose(camera, one.corners_px, one.range_m, one.beam) for one in sights]
    poses = [one[0] for one in found if one is not None]
    places = np.array([pose.apply(numbers[1:4]) for pose in poses])
    lines = places / np.linalg.norm(places, axis=1)[:, None]
    axes = np.array([pose.rotation[:, 0] for pose in poses])
    tilt = float(np.mean(np.linalg.norm(np.cross(lines, axes), axis=1)))
    across_m = float(places[:, 2].mean()) / math.sqrt(camera.fx * camera.fy)
    return across_m, across_m / tilt
