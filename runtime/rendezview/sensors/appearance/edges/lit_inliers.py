"""Contour points with an edge in place, where a part of the target may lie in the dark."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.alignment import AGREEING, CLOSE_PX
from rendezview.sensors.appearance.edges.predicted import FOUND, NOT_FOUND, RESIDUAL, STATE, U, V

# Of the grey above the sky at the upper quartile of the points with an edge: below it a point lies
# in the dark. Source: close-in (0.1), seeds 5 (Mitsuba) and 7, and approach 24 with a wing in
# the dark: right poses then have shares of 0.54 or more, wrong ones 0.34 or less
_LIT = 0.2
_AROUND_PX = (-4, 0, 4)  # px; where the grey beside an edge is read. Source: as above


def lit_inliers(edges: Array, image: Picture, level_grey: float) -> tuple[float, int]:
    """Share of the lit contour points in the picture with an edge in place; how many are lit.

    Points without an edge where the picture is dark do not count: a wing that the Sun does not
    reach says nothing. An edge counts as in ``inlier_ratios``, of whose measurements
    (N, COLUMNS) these are; ``level_grey`` is the sky's.
    """
    states = edges[:, STATE]
    found, missing = states == FOUND, states == NOT_FOUND
    if not found.any():
        return 0.0, int(np.sum(missing))
    grey = _grey_around(image, edges[:, (U, V)]) - level_grey
    lit = missing & (grey > _LIT * np.percentile(grey[found], 75.0))
    count = int(np.sum(found) + np.sum(lit))
    off = edges[found, RESIDUAL] / (AGREEING * CLOSE_PX)
    return float(np.sum(np.exp(-0.5 * off**2))) / count, count


def _grey_around(image: Picture, pixels: Array) -> Array:
    """(N,) mean grey level on a grid of nine pixels around (N, 2) pixels."""
    height, width = image.shape
    columns, rows = np.rint(pixels).astype(np.intp).T
    total = np.zeros(len(pixels))
    for down in _AROUND_PX:
        for right in _AROUND_PX:
            row = np.clip(rows + down, 0, height - 1)
            total += image[row, np.clip(columns + right, 0, width - 1)]
    mean: Array = total / len(_AROUND_PX) ** 2
    return mean
