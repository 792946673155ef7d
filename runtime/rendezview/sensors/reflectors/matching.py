"""Matches further spots to the reflectors that a pose predicts."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.sensors.reflectors.discs import disc_radius, placed, project_disc, turned
from rendezview.sensors.reflectors.spots import SIZE
from rendezview.sensors.reflectors.triplets import expected_size

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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
        if chosen >= 0:
            which[count], where[count] = k, chosen
            count += 1
    return count
