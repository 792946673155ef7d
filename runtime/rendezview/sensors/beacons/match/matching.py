"""Matches further spots to the reflectors that a pose predicts."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.sensors.beacons.detect.discs import (
    disc_radius,
    expected_size,
    placed,
    project_disc,
    turned,
)
from rendezview.sensors.beacons.detect.spot_columns import SIZE
from rendezview.sensors.beacons.match.judgement import common_variance

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# Of a spot's distance to one reflector, that to another: then it is the other's. Source: by
# construction, a third of the way between the two
_NEARER = 0.5


@njit(cache=True, nogil=True, error_model="numpy")
def expect_spots(
    lens: Array, points: Array, normals: Array, diameters: Array, rotation: Array,
    translation: Array, focal_px: float, blur_px: float, out: Array,
) -> None:  # fmt: skip
    """(N, 3) place and size of every reflector at a pose; NaN where it faces away or is behind."""
    for i in range(points.shape[0]):
        x, y, z = placed(rotation, translation, points, i)
        far = math.sqrt(x * x + y * y + z * z)
        nx, ny, nz = turned(rotation, normals, i)
        facing = -(nx * x + ny * y + nz * z) / far
        out[i, 0], out[i, 1] = project_disc(lens, x, y, z, nx, ny, nz, 0.5 * diameters[i])
        if not (facing > 0.0 and z > 0.0):
            out[i, 0] = np.nan
            continue
        out[i, 2] = expected_size(
            blur_px, disc_radius(focal_px, x, y, z, nx, ny, nz, 0.5 * diameters[i])
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _another_nearer(expected: Array, k: int, spot: Array, offset: float) -> bool:
    """Whether a spot is clearly nearer to another reflector: that of a neighbour that is hidden."""
    for j in range(expected.shape[0]):
        x, y = expected[j, 0], expected[j, 1]
        if j != k and math.hypot(spot[0] - x, spot[1] - y) < _NEARER * offset:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def match_spots(
    lens: Array, points: Array, normals: Array, diameters: Array, rotation: Array,
    translation: Array, focal_px: float, blur_px: float, order: Ints, table: Array, usable: Ints,
    three: Ints, limits: tuple[float, float], which: Ints, where: Ints,
) -> int:  # fmt: skip
    """Reflectors and the spots that agree with a pose in place and size."""
    match_px, size_limit = limits
    expected = np.empty((points.shape[0], 3))
    expect_spots(
        lens, points, normals, diameters, rotation, translation, focal_px, blur_px, expected
    )
    bx, by = table[three[2], 0] - table[three[0], 0], table[three[2], 1] - table[three[0], 1]
    base = max(math.sqrt(bx * bx + by * by), 1.0)
    count = 0
    for k in order:
        x, y, size = expected[k]
        if not (math.isfinite(x) and math.isfinite(y)):
            continue
        away = math.hypot(x - table[three[1], 0], y - table[three[1], 1])
        # Away from the three a pose's error grows: by so many base lengths.
        nearest, chosen = match_px * max(1.0, away / base), -1
        for s in usable:
            offset = math.hypot(table[s, 0] - x, table[s, 1] - y)
            if offset >= nearest or abs(math.log(table[s, SIZE] / size)) > size_limit:
                continue
            taken = False
            for c in range(count):
                taken = taken or where[c] == s
            if not taken:
                nearest, chosen = offset, s
        if chosen >= 0 and _another_nearer(expected, k, table[chosen], nearest):
            continue
        if chosen >= 0:
            which[count], where[count] = k, chosen
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def match_all(
    lens: Array, points: Array, normals: Array, diameters: Array, poses: Array, focal_px: float,
    blur_px: float, orders: Ints, table: Array, usable: Ints, triplets: Ints,
    limits: tuple[float, float], counts: Ints, which: Ints, where: Ints,
) -> None:  # fmt: skip
    """`match_spots` of K poses (K, 12); fills counts (K,), which and where (K, N)."""
    for k in range(poses.shape[0]):
        counts[k] = match_spots(
            lens, points, normals, diameters, poses[k, :9].copy().reshape(3, 3), poses[k, 9:],
            focal_px, blur_px, orders[k], table, usable, triplets[k], limits, which[k], where[k],
        )  # fmt: skip
        # In the order of the reflectors, so that equal matches compare equal.
        for i in range(1, counts[k]):
            for j in range(i, 0, -1):
                if which[k, j - 1] > which[k, j]:
                    which[k, j - 1], which[k, j] = which[k, j], which[k, j - 1]
                    where[k, j - 1], where[k, j] = where[k, j], where[k, j - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def size_score(
    points: Array, normals: Array, diameters: Array, rotation: Array, translation: Array,
    focal_px: float, blur_px: float, sizes: Array, sigmas: tuple[float, float, float],
) -> float:  # fmt: skip
    """χ² of the sizes of spots (N,) at a pose; ``sigmas`` of one, of ln diameter and of ln blur."""
    size_sigma, diameter_sigma, blur_sigma = sigmas
    count, mean, squares, common = points.shape[0], 0.0, 0.0, 0.0
    for i in range(count):
        x, y, z = placed(rotation, translation, points, i)
        nx, ny, nz = turned(rotation, normals, i)
        expected = expected_size(
            blur_px, disc_radius(focal_px, x, y, z, nx, ny, nz, 0.5 * diameters[i])
        )
        error = math.log(sizes[i] / expected)
        mean += error / count
        squares += error * error
        common += common_variance(blur_px / expected, diameter_sigma, blur_sigma) / count
    own = max(squares - count * mean * mean, 0.0) / (size_sigma * size_sigma)
    return float(own + mean * mean / (size_sigma * size_sigma / count + common))
