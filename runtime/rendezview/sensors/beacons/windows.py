"""The search for spots in small windows about the places where they are expected."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into
from rendezview.sensors.beacons.detect.labels import gather
from rendezview.sensors.beacons.detect.spot_columns import (
    AMPLITUDE,
    AREA,
    BOTTOM,
    COLUMNS,
    LEFT,
    RIGHT,
    RIVALS,
    TOP,
    X,
    Y,
)
from rendezview.sensors.beacons.detect.spots import window_centroid

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.int64]

_Options = tuple[float, float, float, float, float]  # see `place_windows`

# × the threshold, of a window's range where a spot may be: the threshold is a third of a Gaussian's
# peak, and an even disc has two thirds of that peak.
_CONTRAST = 1.8  # Source: by construction

_NO_WINDOW, _NOTHING, _STRANGER, VISIBLE = range(4)


@njit(cache=True, nogil=True, error_model="numpy")
def read_windows(
    lit: Grey, dark: Grey, expected: Array, half: Array, level: Array, noise: float,
    table: Array, rival: Array, outcome: Ints,
) -> None:  # fmt: skip
    """Look for one spot in each window.

    Args:
        lit, dark: (H, W) pictures, the dark one (0, 0) where there is none.
        expected: (N, 3) x, y, size in px; NaN where no spot is to be looked for.
        half: (N,) half width of the windows, px.
        level: (N,) threshold of the difference, grey.
        noise: of one pixel of the difference, grey.
        table: (N, COLUMNS) rows of the spot table, filled where a spot is found.
        rival: (N, COLUMNS) the second-best spot of each window, NaN where there is none.
        outcome: (N,) 0 window outside the picture, 1 nothing in it, 2 spots that are not a
            reflector, 3 visible.
    """
    height, width = lit.shape
    columns, rows = np.empty(width), np.empty(height)
    for i in range(expected.shape[0]):
        outcome[i], rival[i, X] = _NO_WINDOW, np.nan
        x, y, size = expected[i, 0], expected[i, 1], expected[i, 2]
        if not (math.isfinite(x) and math.isfinite(y)):
            continue
        # A spot whose middle is in the window may reach out of it.
        reach = half[i] + 3.0 * size + 1.0
        x0, x1 = max(math.ceil(x - reach), 0), min(math.floor(x + reach), width - 1)
        y0, y1 = max(math.ceil(y - reach), 0), min(math.floor(y + reach), height - 1)
        if x1 - x0 < 2 or y1 - y0 < 2:
            continue
        outcome[i] = _search_window(
            lit, dark, expected[i], half[i], level[i], noise, (x0, x1, y0, y1), columns,
            rows, table[i], rival[i],
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _search_window(
    lit: Grey, dark: Grey, expected: Array, half: float, level: float, noise: float,
    box: tuple[int, int, int, int], columns: Array, rows: Array, best_row: Array, next_row: Array,
) -> int:  # fmt: skip
    """Outcome of one window; the rows of the two spots nearest in place."""
    x0, x1, y0, y1 = box
    w, h = x1 - x0 + 1, y1 - y0 + 1
    # Copies: a view of a picture would be another type, for which all is compiled again.
    part = np.empty((h, w), np.uint8)
    part_dark = np.empty((min(h, dark.shape[0]), w), np.uint8)  # no rows without a dark picture
    flat, stack, row = np.empty(w * h, np.uint8), np.empty(w * h, np.int32), np.empty(COLUMNS)
    rim, least, most = _copy_window(lit, dark, (x0, y0), part, part_dark)
    outcome, best = _NOTHING, np.inf
    # A single picture: what is behind the spot may be darker than the window's rim.
    for attempt in range(2 if most - least > _CONTRAST * level else 1):
        second, spots, next_row[X] = np.inf, 0, np.nan
        floor = 0.5 * (least + most) if attempt else rim + level
        _mark(part, part_dark, floor, flat)
        for start in range(w * h):
            if flat[start] == 0:
                continue
            gather(flat, w, h, start, part, part_dark, floor, stack, row)
            if row[AREA] < max(3.0, expected[2] ** 2):  # noise, or a spot's tip: whole it has 7 σ²
                continue
            outcome = max(outcome, _STRANGER)
            inside = row[LEFT] > 0 and row[TOP] > 0 and row[RIGHT] < w - 1 and row[BOTTOM] < h - 1
            if not inside:
                continue
            for k in (8, 10, 12, 14):  # from window to picture
                row[k] += x0
                row[k + 1] += y0
            window_centroid(lit, dark, row, noise, columns, rows)
            if attempt and row[AMPLITUDE] < level:
                continue
            spots += 1
            off = math.hypot(row[X] - expected[0], row[Y] - expected[1])
            if off > half:
                continue
            if off < best:
                if best < second:
                    second = best
                    copy_into(best_row, next_row)
                best, outcome = off, VISIBLE
                copy_into(row, best_row)
            elif off < second:
                second = off
                copy_into(row, next_row)
        if outcome == VISIBLE:
            best_row[RIVALS] = spots - 1
            break
    return outcome


@njit(cache=True, nogil=True, error_model="numpy")
def _copy_window(
    lit: Grey, dark: Grey, corner: tuple[int, int], part: Grey, part_dark: Grey
) -> tuple[float, float, float]:
    """Copy a window; the mean of its upper and lower rim, its least and its most, grey.

    All are 0 where there is a dark picture: a difference has no background.
    """
    h, w = part.shape
    for v in range(h):
        for u in range(w):
            part[v, u] = lit[v + corner[1], u + corner[0]]
            if part_dark.shape[0] > 0:
                part_dark[v, u] = dark[v + corner[1], u + corner[0]]
    if part_dark.shape[0] > 0:
        return 0.0, 0.0, 0.0
    rim, least, most = 0.0, 255.0, 0.0
    for u in range(w):
        rim += float(part[0, u]) + float(part[h - 1, u])
    for v in range(h):
        for u in range(w):
            least, most = min(least, float(part[v, u])), max(most, float(part[v, u]))
    return rim / (2 * w), least, most


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(part: Grey, part_dark: Grey, floor: float, flat: Grey) -> None:
    """Mark the pixels of a window above a threshold, in ``flat``."""
    h, w = part.shape
    for v in range(h):
        for u in range(w):
            value = float(part[v, u])
            if part_dark.shape[0] > 0:
                value -= part_dark[v, u]
            flat[v * w + u] = 255 if value > floor else 0


@njit(cache=True, nogil=True, error_model="numpy")
def window_noise(lit: Grey, dark: Grey, expected: Array, half: Array) -> float:
    """Noise of one pixel of the difference from the windows' rims, grey levels.

    From neighbours along the upper and lower rim, where no spot is; the mean absolute step
    of a normal distribution is 2 σ/√π.
    """
    height, width = lit.shape
    total, count = 0.0, 0
    for i in range(expected.shape[0]):
        x, y = expected[i, 0], expected[i, 1]
        if not (math.isfinite(x) and math.isfinite(y)):
            continue
        reach = half[i] + 3.0 * expected[i, 2] + 1.0
        x0, x1 = max(int(x - reach), 0), min(int(x + reach), width - 2)
        for edge in range(2):
            v = int(y - reach) if edge == 0 else int(y + reach)
            if v < 0 or v >= height:
                continue
            for u in range(x0, x1):
                step = float(lit[v, u + 1]) - float(lit[v, u])
                if dark.shape[0] > 0:
                    step -= float(dark[v, u + 1]) - float(dark[v, u])
                total += abs(step)
                count += 1
    if count < 8:
        return -1.0
    return max(total / count * math.sqrt(math.pi) / 2.0, 0.3)


@njit(cache=True, nogil=True, error_model="numpy")
def place_windows(
    expected: Array, places: Array, before: Array, brightness: Array, aged: Ints, ratio: float,
    misses: int, options: _Options, half: Array, level: Array,
) -> None:  # fmt: skip
    """Move the places that a pose predicts by the last motion; set half widths and thresholds.

    Book et al.: the centroid plus its last step. A reflector that was not visible twice takes the
    mean step of the others. Threshold: a third of the brightness expected.

    Args:
        expected: (N, 3) x, y, size at the last pose; moved in place, NaN where not visible.
        places, before: (N, 2) of the last reading and of the one before, NaN where not visible.
        brightness: (N,) grey, when last visible; aged: (N,) readings ago.
        ratio: time to the next reading over time between the last two.
        misses: readings in a row without a pose.
        options: window_sizes, window_px, coasting_px, window_share, least_grey.
        half, level: (N,) results.
    """
    (sizes, extra, coasting, share, least), count = options, expected.shape[0]
    mean_x = mean_y = usual = 0.0
    moving = shining = 0
    for i in range(count):
        if math.isfinite(places[i, 0]) and math.isfinite(before[i, 0]):
            mean_x += places[i, 0] - before[i, 0]
            mean_y += places[i, 1] - before[i, 1]
            moving += 1
        if math.isfinite(brightness[i]):
            usual += brightness[i]
            shining += 1
    if moving:
        mean_x, mean_y = mean_x / moving, mean_y / moving
    if shining:
        usual /= shining
    for i in range(count):
        if not math.isfinite(expected[i, 0]):
            continue
        if math.isfinite(places[i, 0]) and math.isfinite(before[i, 0]):
            expected[i, 0] += ratio * (places[i, 0] - before[i, 0])
            expected[i, 1] += ratio * (places[i, 1] - before[i, 1])
        else:
            expected[i, 0] += ratio * mean_x
            expected[i, 1] += ratio * mean_y
    for i in range(count):
        nearest = np.inf
        for j in range(count):
            if j != i and math.isfinite(expected[j, 0]):
                nearest = min(
                    nearest,
                    math.hypot(expected[i, 0] - expected[j, 0], expected[i, 1] - expected[j, 1]),
                )
        wide = sizes * expected[i, 2] + extra + coasting * (misses + aged[i])
        half[i] = min(wide, share * nearest)
        bright = brightness[i] if math.isfinite(brightness[i]) else usual
        level[i] = max(bright / 3.0, least)
