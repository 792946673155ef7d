"""Spots beside their neighbours: whether one is partly hidden, or may be another light.

An edge that hides a part of a disc moves the middle of what is left, along its narrow axis. The
elongation beside that of its neighbours tells by how much, not which way; it also tells how much
smaller the spot is. Another light in a reflector's place has another size or brightness.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.discs import disc_radius, expected_size, placed, turned
from rendezview.sensors.beacons.detect.spot_columns import AMPLITUDE, LONG_X, LONG_XY, SIGMA, SIZE

Ints = npt.NDArray[np.int64]

# An edge across a disc moves the middle of what is left by its size × √share × x × (first + second
# × x) × (1 + third × (1 − share)), x its elongation over the share of the disc in its size.
# Source: plain simulator, 10 to 50 % hidden at 0.8 to 6 m, within 6 %; at 10 m a sixth too much
_SHIFT = (1.25, 3.3, 0.65)
# radii that an edge moves it at most. Source: by construction, two thirds hidden
_FARTHEST = 0.6
# of a spot's own elongation a Gaussian window of its size shows so much. Source: by construction
_WINDOWED = 0.5
# × the disc's share: σ of an elongation beside its neighbours', but for the noise.
# Source: experiment reflector-nees --kind retro
_ROUND_SIGMA = 0.007
# σ of an elongation over that of the place, in sizes; simulated 0.8
_NOISE = 0.8  # Source: experiment reflector-nees --kind retro
# σ; clean spots exceed it once in 200. Below it an edge counts by the square of a round spot's
# likelihood there over its own, which adds 6 % to a clean pose's σ at 10 m.
_SURE = 2.7  # Source: reflector-nees --kind retro and "20 % covered", seeds 403 and 404
# ln(size) that a covered disc loses: × its elongation, and × the square of that over the disc's
# share. Source: plain simulator, 5 to 50 % hidden: within a quarter at 0.8 to 1.5 m, up to a half
# too low at 3 to 6 m
_SMALLER, _SMALLER_YET = 0.45, 1.0
_QUARTER = 0.25  # Source: likewise
# Elongation from which a spot seems hidden before there is a pose: 30° of tilt changes it so much
# across a target as wide as half its range. And ln(size) at most, half of a disc's.
_APPARENT, _LARGEST = 0.1, 0.35  # Source: likewise
_DIMMER = 2.0  # × elongation: σ of ln(brightness) of a covered disc. Source: likewise
# Of ln(size): noise, focus, the disc's own tilt. Source: by hand; uncritical halved or doubled
SIZE_SIGMA = 0.035
# of ln(brightness) over its neighbours' since it was last certain, and a √reading since then.
# Source: `reflector-hidden --scene glint`, seeds 7 and 1007; a walk of 0.05 lets more glints pass
_BRIGHTNESS_SIGMA, _BRIGHTNESS_WALK = 0.05, 0.02
# × the share of light that is too much, × size: σ of the place of two lights that run together.
# Source: by construction, half a size apart they look as one
_OVER = 0.5


def compare_spots(
    rows: Array, pattern: ReflectorPattern, which: Ints, pose: Pose, focal_px: float,
    blur_px: float, scale: Array | None = None, brightness: Array | None = None,
    aged: Ints | None = None,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Compare the spots of one reading with each other.

    Args:
        rows: (K, COLUMNS) of the spot table.
        pattern: the reflectors; which: (K,) whose spots these are.
        pose: of the target, near enough for the shape of its discs.
        focal_px: of the camera; blur_px: σ of the optics and a pixel's width together.
        scale: (K,) of the discs' extent by the lens, `LensScale`; 1 where not given.
        brightness: (N,) grey of the reflectors when last certain, NaN where never.
        aged: (N,) readings since then.

    Returns:
        (K,) σ of each spot's place by what hides a part of it, px, 0 where nothing does; the same
        by what may hide one unnoticed; χ² of its size and brightness. All 0 of fewer than three,
        or saturated, spots.
    """
    known = np.full(len(pattern), np.nan) if brightness is None else brightness
    ago = np.zeros(len(pattern), np.int64) if aged is None else aged
    scale = np.ones(len(rows)) if scale is None else scale
    cover, unsure, light = np.zeros((3, len(rows)))
    _compare(
        np.ascontiguousarray(rows), pattern.positions_m, pattern.normals, pattern.diameters_m,
        np.asarray(which, np.int64), pose.rotation.copy(), pose.translation_m.copy(), focal_px,
        blur_px, scale, known, ago, cover, unsure, light,
    )  # fmt: skip
    return cover, unsure, light


def uncovered_sizes(rows: Array, blur_px: float) -> Array:
    """(K,) sizes of spots (K, COLUMNS), px, those that seem partly hidden as they would be whole.

    Before there is a pose the middle of all spots stands for the shape that tilt gives a disc.
    """
    long = rows[:, [LONG_X, LONG_XY]]
    if np.isfinite(long).all(axis=1).sum() < 3:
        return np.array(rows[:, SIZE])
    hidden = np.nan_to_num(np.linalg.norm(long - np.nanmedian(long, axis=0), axis=1))
    hidden[hidden < _APPARENT] = 0.0
    share = np.maximum(1.0 - (blur_px / rows[:, SIZE]) ** 2, 0.01)
    smaller = hidden * (_SMALLER + _SMALLER_YET * hidden / share)
    return np.asarray(rows[:, SIZE] * np.exp(np.minimum(smaller, _LARGEST)))


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(
    rows: Array, points: Array, normals: Array, diameters: Array, which: Ints, rotation: Array,
    translation: Array, focal_px: float, blur_px: float, scale: Array, brightness: Array,
    aged: Ints, cover: Array, unsure: Array, light: Array,
) -> None:  # fmt: skip
    """Fill `compare_spots`' results, which are zeros before."""
    count = rows.shape[0]
    # Elongation, two numbers, ln(size), ln(brightness): each beside the middle of all.
    beside, share, half = np.empty((4, count)), np.empty(count), np.empty(count)
    for i in range(count):
        k, size = which[i], rows[i, SIZE]
        x, y, z = placed(rotation, translation, points, k)
        nx, ny, nz = turned(rotation, normals, k)
        radius = scale[i] * disc_radius(focal_px, x, y, z, nx, ny, nz, 0.5 * diameters[k])
        half[i] = _FARTHEST * radius
        # Of a spot that is mostly blur, little of the shape is the disc's.
        share[i] = max(1.0 - (blur_px / size) ** 2, 0.01)
        xx, yy, xy = _shape(x / z, y / z, nx, ny, nz)
        windowed = _WINDOWED * share[i] / (xx + yy)
        beside[0, i] = rows[i, LONG_X] - windowed * (xx - yy)
        beside[1, i] = rows[i, LONG_XY] - windowed * 2.0 * xy
        beside[2, i] = math.log(size / expected_size(blur_px, radius))
        beside[3, i] = math.log(rows[i, AMPLITUDE] / brightness[k])
    for part in range(4):
        beside[part] -= middle(beside[part])
    common = middle(rows[:, SIGMA].copy() / rows[:, SIZE])  # a strange spot's own may be larger
    for i in range(count):
        off, hidden = math.hypot(beside[0, i], beside[1, i]), 0.0
        odd = (off / math.hypot(_ROUND_SIGMA * share[i], _NOISE * common)) ** 2
        if math.isfinite(odd):
            moved = min(_moved(off, share[i], rows[i, SIZE]), half[i])
            moved /= math.sqrt(2.0)  # either way
            if odd > _SURE**2:
                hidden, cover[i] = off, moved
            else:
                unsure[i] = moved * math.exp(0.5 * (odd - _SURE**2))
        noise = (rows[i, SIGMA] / rows[i, SIZE]) ** 2
        smaller = _shrunk(hidden, share[i])
        spread = SIZE_SIGMA**2 + (_QUARTER * smaller) ** 2 + noise
        size = beside[2, i] + (smaller if beside[2, i] < 0.0 else 0.0)
        dim = _BRIGHTNESS_SIGMA**2 + _BRIGHTNESS_WALK**2 * aged[which[i]]
        dim += (_DIMMER * hidden) ** 2 + 2.0 * noise
        tracked = math.isfinite(beside[3, i])
        if not math.isfinite(off):  # a saturated spot's size is that of its rim
            size = 0.0
        for value, variance in ((size, spread), (beside[3, i], dim)):
            if tracked and value > _SURE * math.sqrt(variance):  # another light may be over it
                over = _OVER * (1.0 - math.exp(-value)) * rows[i, SIZE]
                cover[i] = math.hypot(cover[i], over)
            elif math.isfinite(value):
                light[i] += value * value / variance


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _moved(off: float, share: float, size: float) -> float:
    """How far, px, an edge moves a spot whose elongation is off by so much."""
    first, second, third = _SHIFT
    x = off / share
    return math.sqrt(share) * size * x * (first + second * x) * (1.0 + third * (1.0 - share))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _shrunk(off: float, share: float) -> float:
    """How much smaller, ln, an edge makes a spot whose elongation is off by so much."""
    return off * (_SMALLER + _SMALLER_YET * off / share)


@njit(cache=True, nogil=True, error_model="numpy")
def middle(values: Array) -> float:
    """Median of the numbers that are finite; NaN of fewer than three."""
    rising, count = np.empty(values.shape[0]), 0
    for value in values:
        if not math.isfinite(value):
            continue
        at = count
        while at and rising[at - 1] > value:
            rising[at] = rising[at - 1]
            at -= 1
        rising[at] = value
        count += 1
    if count < 3:
        return np.nan
    return float(0.5 * (rising[(count - 1) // 2] + rising[count // 2]))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _shape(
    u: float, v: float, nx: float, ny: float, nz: float
) -> tuple[float, float, float]:  # fmt: skip
    """Second moments xx, yy, xy of a disc in the picture: of its plane under the projection."""
    a, b = nx - nz * u, ny - nz * v
    return 1.0 + u * u - a * a, 1.0 + v * v - b * b, u * v - a * b
