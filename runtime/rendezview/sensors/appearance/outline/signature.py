"""The radial signature: distance from the centroid to the outermost edge, in N directions.

Readings are whole thousandths of the square root of the silhouette's area, so a
signature does not change with range, focal length or brightness; bin 0 looks East (+x),
the bins run counter-clockwise as seen on the screen (Cleghorn & Sternberg, figure 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, minimal_rotation
from rendezview.sensors.appearance.outline.tracing import radial_maxima, spokes_of, vector_area

Readings = npt.NDArray[np.float32]  # whole numbers
UNIT = 1000.0  # readings per square root of the area
_BORESIGHT = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Signature:
    """What one silhouette looks like from its own centroid."""

    readings: Readings  # (N,) whole thousandths of sqrt(area), smoothed
    area_sr: float  # the silhouette's area on the sphere of directions
    centred_from_camera: Array  # (3, 3) turns the centroid to the boresight

    @classmethod
    def of_outlines(
        cls, outlines: Sequence[Array], bins: int, smooth_bins: int = 1
    ) -> Signature | None:
        """Signature of outlines (M, 3) given as rays in the camera frame.

        ``None`` where the outlines enclose nothing.
        """
        total = np.zeros(3)
        for rays in outlines:
            total += vector_area(rays)
        area_sr = float(np.sqrt(total @ total))
        if not area_sr > 0.0:
            return None
        centred_from_camera = minimal_rotation(total, _BORESIGHT)
        maxima = np.zeros(bins)
        for rays in outlines:
            radial_maxima(rays, centred_from_camera, spokes_of(bins), maxima)
        readings = quantised(maxima, UNIT / np.sqrt(area_sr), smooth_bins)
        return cls(readings, area_sr, centred_from_camera)


@njit(cache=True, nogil=True)
def quantised(maxima: Array, scale: float, smooth_bins: int) -> Readings:
    """Running mean over an odd number of bins, scaled and rounded to whole readings."""
    bins = maxima.shape[0]
    half = smooth_bins // 2
    readings = np.empty(bins, dtype=np.float32)
    running = 0.0
    for k in range(-half, half + 1):
        running += maxima[k % bins]
    factor = scale / (2 * half + 1)
    for b in range(bins):
        readings[b] = np.rint(running * factor)
        running += maxima[(b + half + 1) % bins] - maxima[(b - half) % bins]
    return readings


@njit(cache=True, nogil=True)
def rolled(readings: Readings, roll_rad: float) -> Readings:
    """The signature that a camera rolled back by ``roll_rad`` about its boresight would see.

    If the view has attitude ``Rz(roll) @ node`` (roll by the right hand about the
    boresight), then this gives the readings as the node's own camera would have them:
    bin b of the result is the reading of the view at the angle of b less the roll.
    """
    bins = readings.shape[0]
    shift = -roll_rad * bins / (2.0 * np.pi)
    whole = int(np.floor(shift))
    part = np.float32(shift - whole)
    out = np.empty(bins, dtype=np.float32)
    for b in range(bins):
        j = (b + whole) % bins
        k = j + 1 if j + 1 < bins else 0
        out[b] = np.rint((np.float32(1.0) - part) * readings[j] + part * readings[k])
    return out


def twist(view_rotations: Array, node_rotation: Array) -> Array:
    """Roll of views (..., 3, 3) against a node (3, 3): the twist of ``view @ nodeᵀ`` about z.

    The rotation between two neighbouring views is a small tilt and a roll about the line
    of sight; this is the roll, with no pole anywhere on the sphere. Radians in (−π, π].
    """
    m = view_rotations @ np.swapaxes(node_rotation, -1, -2)
    return np.asarray(
        np.arctan2(m[..., 1, 0] - m[..., 0, 1], m[..., 0, 0] + m[..., 1, 1]), dtype=np.float64
    )
