"""Connected pixels of a mask: one row of the table of spots for each region."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.difference import Grey
from rendezview.sensors.beacons.detect.spot_columns import (
    ABOVE,
    AMPLITUDE,
    AREA,
    BINARY_X,
    BINARY_Y,
    BOTTOM,
    LEFT,
    PEAK,
    RIGHT,
    SATURATED,
    SHAPE,
    SIZE,
    TOP,
    WEIGHTED_X,
    WEIGHTED_Y,
)

SATURATED_GREY = 255  # grey. Source: by construction, 8 bits


def label(mask: Grey, lit: Grey, dark: Grey, level: float, table: Array) -> int:
    """Fill rows with the regions of a mask (H, W), which is lost; −1 where there are too many."""
    flat = mask.reshape(-1)
    words = flat[: flat.size - flat.size % 8].view(np.uint64)
    stack = np.empty(max(flat.size, 1), np.int32)
    return int(_label_loop(mask, words, lit, dark, level, stack, table))


@njit(cache=True, nogil=True, error_model="numpy")
def _label_loop(
    mask: Grey, words: npt.NDArray[np.uint64], lit: Grey, dark: Grey, level: float,
    stack: npt.NDArray[np.int32], table: Array,
) -> int:  # fmt: skip
    height, width = mask.shape
    flat = mask.reshape(-1)
    count = 0
    for w in range(words.shape[0] + 1):
        if w < words.shape[0] and words[w] == 0:
            continue
        for start in range(8 * w, min(8 * w + 8, flat.shape[0])):
            if flat[start] == 0:
                continue
            if count == table.shape[0]:
                return -1
            gather(flat, width, height, start, lit, dark, level, stack, table[count])
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def gather(
    flat: Grey, width: int, height: int, start: int, lit: Grey, dark: Grey, level: float,
    stack: npt.NDArray[np.int32], row: Array,
) -> None:  # fmt: skip
    """Zero a spot out of the mask, layer by layer, and fill its row (8-connected)."""
    has_dark = dark.shape[0] > 0
    area = saturated = 0
    bx = by = wx = wy = flux = peak = 0.0
    xx = yy = xy = 0.0
    left, right, top, bottom = width, -1, height, -1
    x_first, y_first = start % width, start // width
    stack[0] = start
    flat[start] = 0
    depth = 1
    while depth:
        depth -= 1
        at = stack[depth]
        y, x = at // width, at % width
        value = float(lit[y, x])
        if lit[y, x] >= SATURATED_GREY:
            saturated += 1
        if has_dark:
            value -= dark[y, x]
        weight = max(value - level, 0.0)
        dx, dy = float(x - x_first), float(y - y_first)
        area += 1
        bx += dx
        by += dy
        flux += weight
        wx += weight * dx
        wy += weight * dy
        xx += weight * dx * dx
        yy += weight * dy * dy
        xy += weight * dx * dy
        peak = max(peak, value)
        left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        for ny in range(max(y - 1, 0), min(y + 2, height)):
            for nx in range(max(x - 1, 0), min(x + 2, width)):
                n = ny * width + nx
                if flat[n]:
                    flat[n] = 0
                    stack[depth] = n
                    depth += 1
    row[AREA], row[AMPLITUDE], row[PEAK], row[SATURATED] = area, peak, peak, saturated
    row[ABOVE] = flux
    row[BINARY_X], row[BINARY_Y] = x_first + bx / area, y_first + by / area
    if flux > 0.0:
        mx, my = wx / flux, wy / flux
        xx, yy, xy = xx / flux - mx * mx, yy / flux - my * my, xy / flux - mx * my
        row[WEIGHTED_X], row[WEIGHTED_Y] = x_first + mx, y_first + my
    else:
        row[WEIGHTED_X], row[WEIGHTED_Y] = row[BINARY_X], row[BINARY_Y]
        xx = yy = xy = 0.0
    row[LEFT], row[TOP], row[RIGHT], row[BOTTOM] = left, top, right, bottom
    # A pixel's own width (1/12) rounds off the shape of the smallest.
    mean, half = 0.5 * (xx + yy) + 1.0 / 12.0, math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    row[SHAPE] = math.sqrt(max(mean - half, 1e-6) / (mean + half))
    row[SIZE] = math.sqrt(mean)
