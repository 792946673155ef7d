"""Gloss: how the brightness of a lit surface differs from that of a matt one, over the picture.

What foil and paint reflect to the camera depends on the directions to the Sun and to the camera.
Over a plane the second varies slowly. Surfaces of nearly one direction therefore get one affine
field of brightness, beside the matt model: steps and shadows stay evidence, slopes do not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import solve
from rendezview.geometry.pose import Array

# Of the geodesic sphere whose 162 nodes are the directions. Source: docs/notes/rivals.md
GLOSS_ORDER = 2
# Pixels, in independent cells: that of the matt model counts as so many. Source: the same
_MATT_CELLS = 1.0
# Of those, for a slope over half the picture. Source: the same
_LEVEL_SHARE = 0.1
_ROUNDS = 3  # of weighted least squares. Source: the same

Indices = npt.NDArray[np.intp]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def add_gloss(
    places: Array, facets: Indices, sunlit: Array, seen: Array, tolerance: float, cell_px: float,
    levels: Array,
) -> None:  # fmt: skip
    """Add to the sunlit pixels of ``levels`` (N,) what a field of each direction explains.

    Args:
        places: (N, 2) columns and rows from the middle of the picture, in halves of a side.
        facets: (N,) numbers of the directions.
        sunlit: (N,) 0 in shadow.
        seen: (N,) grey levels.
        tolerance: grey levels beyond which a level is an outlier.
        cell_px: pixels of an independent cell.
        levels: (N,) of the matt model; they stay above black.
    """
    count = 0
    for facet in facets:
        count = max(count, facet + 1)
    fields, normal, right = np.zeros((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3))
    lower = np.empty((3, 3))
    for step in range(_ROUNDS):
        _sums(places, facets, sunlit, seen, levels, tolerance, fields, step, normal, right)
        for k in range(count):
            if normal[k, 0, 0] > 0.0:
                for i in range(3):
                    normal[k, i, i] += _MATT_CELLS * cell_px * (1.0 if i == 0 else _LEVEL_SHARE)
                solve(normal[k], right[k], lower, fields[k])
    for n in range(len(levels)):
        if not sunlit[n] > 0.0:
            continue
        k = facets[n]
        more = fields[k, 0] + fields[k, 1] * places[n, 0] + fields[k, 2] * places[n, 1]
        levels[n] = max(levels[n] + more, 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _sums(
    places: Array, facets: Indices, sunlit: Array, seen: Array, levels: Array, tolerance: float,
    fields: Array, step: int, normal: Array, right: Array,
) -> None:  # fmt: skip
    """Normal equations (K, 3, 3), (K, 3) of all fields; those before give the weights."""
    normal[:] = 0.0
    right[:] = 0.0
    for n in range(len(levels)):
        if not sunlit[n] > 0.0:
            continue
        k, x, y, rest, weight = facets[n], places[n, 0], places[n, 1], seen[n] - levels[n], 1.0
        if step > 0:  # Geman and McClure 1987
            r = (rest - fields[k, 0] - fields[k, 1] * x - fields[k, 2] * y) / tolerance
            weight = 1.0 / (1.0 + r * r)
            weight *= weight
        wx, wy, wr = weight * x, weight * y, weight * rest
        normal[k, 0, 0] += weight
        normal[k, 1, 0] += wx
        normal[k, 1, 1] += wx * x
        normal[k, 2, 0] += wy
        normal[k, 2, 1] += wy * x
        normal[k, 2, 2] += wy * y
        right[k, 0] += wr
        right[k, 1] += wr * x
        right[k, 2] += wr * y
