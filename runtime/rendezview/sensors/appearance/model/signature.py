"""The radial signature: distance from the centroid to the outermost edge, in N directions.

An outline is a closed polygon of rays ``(x, y, 1)`` in the camera frame. Its *vector area*
``½ ∮ r × dr`` over unit rays r is ``∫ r dΩ`` over the silhouette: its direction is the centroid
on the sphere of directions, its length the area. The rays are turned so that the centroid is on
the boresight, so a target off the boresight needs no further correction.

Readings are whole thousandths of the square root of the area. A signature therefore does not
change with range, focal length or brightness. Bin 0 looks East (+x); the bins run
counter-clockwise on the screen (Cleghorn & Sternberg, figure 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, minimal_rotation

Readings = npt.NDArray[np.float32]  # whole numbers
UNIT = 1000.0  # readings per square root of the area. Source: by construction
BORESIGHT = np.array([0.0, 0.0, 1.0])  # camera frame. Source: by construction
_AHEAD = 1e-9  # least z of a ray in front of the camera. Source: by construction
_ALONG = 1e-300  # a smaller cross product is that of a segment along a ray. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Signature:
    """The radial signature of one silhouette, with its area and its centroid."""

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
        centred_from_camera = minimal_rotation(total, BORESIGHT)
        maxima = np.zeros(bins)
        for rays in outlines:
            radial_maxima(rays, centred_from_camera, spokes_of(bins), maxima)
        readings = quantised(maxima, UNIT / np.sqrt(area_sr), smooth_bins)
        return cls(readings, area_sr, centred_from_camera)


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """The outlines of one silhouette as rays, and their signature."""

    rays: list[Array]  # (M, 3) each, camera frame
    signature: Signature


@njit(cache=True, nogil=True, error_model="numpy")
def vector_area(rays: Array) -> Array:
    """``½ ∮ r × dr`` of a closed polygon of rays (M, 3) of any length; (3,) steradians.

    An outline that is counter-clockwise on the screen (x right, y down) would give −z, so the
    sign is changed: the result points to the silhouette.
    """
    total = np.zeros(3)
    m = rays.shape[0]
    if m == 0:
        return total
    x, y, z = rays[m - 1, 0], rays[m - 1, 1], rays[m - 1, 2]
    length = np.sqrt(x * x + y * y + z * z)
    ax, ay, az = x / length, y / length, z / length
    for i in range(m):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        bx, by, bz = x * scale, y * scale, z * scale
        total[0] -= 0.5 * (ay * bz - az * by)
        total[1] -= 0.5 * (az * bx - ax * bz)
        total[2] -= 0.5 * (ax * by - ay * bx)
        ax, ay, az = bx, by, bz
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def radial_maxima(rays: Array, centred_from_camera: Array, spokes: Array, maxima: Array) -> None:
    """Raise each bin to the distance of one outline's outermost edge, if that is larger.

    Bin k looks along the angle ``2πk/N`` from East, counter-clockwise on the screen. Its
    distance is that of the farthest crossing of its spoke with the outline, in the plane at
    unit distance across the boresight (Cleghorn & Sternberg, figure 2).

    Args:
        rays: (M, 3) closed polygon in the camera frame.
        centred_from_camera: (3, 3) rotation that puts the centroid on the boresight.
        spokes: (N, 2) direction of each bin, see ``spokes_of``.
        maxima: (N,) the distances so far, changed in place.
    """
    m, bins = rays.shape[0], maxima.shape[0]
    if m == 0:
        return
    per_radian = bins / (2.0 * np.pi)
    q = centred_from_camera
    xs, ys, zs, turns = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    nearest = np.inf
    for k in range(m):  # without a branch, so that several points are taken at once
        rx, ry, rz = rays[k, 0], rays[k, 1], rays[k, 2]
        z = q[2, 0] * rx + q[2, 1] * ry + q[2, 2] * rz
        nearest = min(nearest, z)
        scale = 1.0 / z
        x = (q[0, 0] * rx + q[0, 1] * ry + q[0, 2] * rz) * scale
        y = -(q[1, 0] * rx + q[1, 1] * ry + q[1, 2] * rz) * scale  # up on the screen
        xs[k], ys[k], zs[k], turns[k] = x, y, z, _nearly_atan2(y, x) * per_radian
    whole = nearest > _AHEAD
    if not (whole or zs[m - 1] > _AHEAD):
        return
    for k in range(m):
        if not (whole or zs[k] > _AHEAD):
            return  # more than a right angle from the centroid: not a target's outline
        _raise_bins(xs[k - 1], ys[k - 1], turns[k - 1], xs[k], ys[k], turns[k], spokes, maxima)


@njit(cache=True, nogil=True, error_model="numpy")
def _raise_bins(
    x0: float,
    y0: float,
    turn0: float,
    x1: float,
    y1: float,
    turn1: float,
    spokes: Array,
    maxima: Array,
) -> None:
    """Raise the bins between the ends of one segment; turns are angles in bins."""
    bins = maxima.shape[0]
    low, high = turn0, turn1
    if high - low > 0.5 * bins:
        low += bins
    elif low - high > 0.5 * bins:
        high += bins
    if low > high:
        low, high = high, low
    first, end = np.ceil(low), np.floor(high) + 1.0
    if first >= end:
        return
    dx, dy = x1 - x0, y1 - y0
    cross = x0 * dy - y0 * dx
    farther = np.sqrt(max(x0 * x0 + y0 * y0, x1 * x1 + y1 * y1))
    for b in range(int(first), int(end)):
        k = b + bins if b < 0 else b
        k -= bins if k >= bins else 0
        across = spokes[k, 0] * dy - spokes[k, 1] * dx
        distance = farther
        if abs(across) > _ALONG:
            distance = min(farther, cross / across)
        if distance > maxima[k]:
            maxima[k] = distance


@njit(cache=True, nogil=True, error_model="numpy")
def _nearly_atan2(y: float, x: float) -> float:
    """atan2 to 1.2e-5 rad; it only decides which bins a segment is tested against.

    Minimax polynomial of odd degree 9 for arctan on [0, 1] (Abramowitz & Stegun 4.4.49).
    """
    ax, ay = abs(x), abs(y)
    t = min(ax, ay) / max(ax, ay, _ALONG)
    s = t * t
    angle = t * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))))
    angle = 0.5 * np.pi - angle if ay > ax else angle
    angle = np.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@lru_cache(maxsize=16)
def spokes_of(bins: int) -> Array:
    """(N, 2) cosine and sine of the angle at which each of N bins looks."""
    angles = 2.0 * np.pi * np.arange(bins) / bins
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    spokes.setflags(write=False)
    return spokes


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def rolled(readings: Readings, roll_rad: float) -> Readings:
    """The signature as a camera rolled back by ``roll_rad`` about its boresight has it.

    A view of attitude ``about_z(roll) @ node`` becomes comparable with the node: bin b
    of the result is the view's reading at the angle of b less the roll.
    """
    out = np.empty(readings.shape[0], dtype=np.float32)
    roll_readings(readings, roll_rad, out)
    for b in range(len(out)):
        out[b] = np.rint(out[b])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def roll_readings(readings: Readings, roll_rad: float, out: Readings) -> None:
    """Fill (N,) with readings rolled back by an angle, between bins by interpolation."""
    bins = len(readings)
    shift = -roll_rad * bins / (2.0 * np.pi)
    whole = int(np.floor(shift))
    part = np.float32(shift - whole)
    j = whole % bins
    for i in range(bins):
        k = j + 1 if j + 1 < bins else 0
        out[i] = (np.float32(1.0) - part) * readings[j] + part * readings[k]
        j = k


@lru_cache(maxsize=8)
def rebinning(bins: int, coarse: int) -> npt.NDArray[np.float32]:
    """(N, C) weights that average the readings of any number of bins over windows of other bins.

    Window k is centred on bin k, so that both signatures have the same roll.
    """
    share = coarse / bins  # of a window that one reading covers, if it is narrower
    apart = np.arange(bins)[:, None] * share - np.arange(coarse)[None, :]
    apart = np.abs(apart - coarse * np.rint(apart / coarse))
    cover = np.clip(0.5 * (1.0 + share) - apart, 0.0, min(1.0, share))
    return np.asarray(cover / cover.sum(axis=0), dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def roll_against(view: Array, node: Array) -> float:
    """``twist`` of one view (3, 3) against one node (3, 3)."""
    c, s = 0.0, 0.0
    for i in range(3):
        c += view[0, i] * node[0, i] + view[1, i] * node[1, i]
        s += view[1, i] * node[0, i] - view[0, i] * node[1, i]
    return np.arctan2(s, c)  # type: ignore[no-any-return]


def twist(view_rotations: Array, node_rotation: Array) -> Array:
    """Roll of views (..., 3, 3) against a node (3, 3), radians in (−π, π].

    The rotation between two neighbouring views is a small tilt and a roll about the line of
    sight. The roll is the twist of ``view @ nodeᵀ`` about z; it has no pole on the sphere.
    """
    m = view_rotations @ np.swapaxes(node_rotation, -1, -2)
    return np.asarray(
        np.arctan2(m[..., 1, 0] - m[..., 0, 1], m[..., 0, 0] + m[..., 1, 1]), dtype=np.float64
    )
