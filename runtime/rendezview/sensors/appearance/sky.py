"""The sky behind the target: its level, its noise, and what stands out of both."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Picture = npt.NDArray[np.uint8]
_MANY = 1000  # windows along two borders
MOST_AVERAGED_PX = 15  # the sum of 15 × 15 levels still fits 16 bits


def sky_level(image: Picture, averaged_px: int = 1) -> tuple[float, float]:
    """Median and spread (one σ, from the darker half) of the grey levels along the border.

    Of means over ``averaged_px`` squared pixels, if that is more than one. The spread is
    that of the brighter half where the darker one is cut off at black. A silhouette that
    touches the border is refused anyway, so what is seen there is sky.
    """
    level, spread = _ring_statistics(image, averaged_px)
    return float(level), float(spread)


def mean_above(image: Picture, level_grey: float, averaged_px: int) -> Picture:
    """(H, W) mask, 255 where the mean over ``averaged_px`` squared pixels is above a level.

    The picture is read once. At its border the outermost pixels are repeated.
    """
    mask = np.empty(image.shape, dtype=np.uint8)
    _mean_above(image, int(np.floor(level_grey * averaged_px**2)), averaged_px, mask)
    return mask


@njit(cache=True, nogil=True)
def _mean_above(image: Picture, limit: int, side: int, mask: Picture) -> None:
    height, width = image.shape
    half = side // 2
    limit16 = np.uint16(max(0, min(limit, 65535)))
    padded = np.zeros(width + 2 * half, dtype=np.uint16)
    columns = padded[half : half + width]  # sums over the rows of the window
    total = np.empty(width, dtype=np.uint16)
    for k in range(-half - 1, half):  # of the window one row above the first
        row = image[min(max(k, 0), height - 1)]
        for x in range(width):
            columns[x] += row[x]
    for y in range(height):
        enters = image[min(y + half, height - 1)]
        leaves = image[max(y - half - 1, 0)]
        for x in range(width):
            columns[x] = columns[x] + np.uint16(enters[x]) - np.uint16(leaves[x])
        padded[:half] = columns[0]
        padded[half + width :] = columns[width - 1]
        before, after = padded[:width], padded[2 * half :]
        for x in range(width):
            total[x] = before[x] + after[x]
        for k in range(1, side - 1):
            shifted = padded[k : k + width]
            for x in range(width):
                total[x] += shifted[x]
        out = mask[y]
        for x in range(width):
            out[x] = 255 if total[x] > limit16 else 0


@njit(cache=True, nogil=True)
def _ring_statistics(image: Picture, side: int) -> tuple[float, float]:
    height, width = image.shape
    counts = np.zeros(256, dtype=np.int64)
    if side == 1 or side >= min(height, width):
        for k in range(min(3, height, width)):
            for x in range(width):
                counts[image[k, x]] += 1
                counts[image[height - 1 - k, x]] += 1
            for y in range(height):
                counts[image[y, k]] += 1
                counts[image[y, width - 1 - k]] += 1
    else:
        # windows side by side are enough where there are many
        step = side if width + height > _MANY else 1
        for x in range(0, width - side + 1, step):
            counts[_mean(image, 0, x, side)] += 1
            counts[_mean(image, height - side, x, side)] += 1
        for y in range(0, height - side + 1, step):
            counts[_mean(image, y, 0, side)] += 1
            counts[_mean(image, y, width - side, side)] += 1
    level = _quantile(counts, 0.5)
    # 15.87 % quantile: one σ below the median of Gaussian noise
    below = _quantile(counts, 0.1587)
    if below > 0.5:
        return level, level - below
    # A black sky, its noise cut off at 0: half a σ above the median, at the 69.15 % quantile.
    return level, max(level - below, 2.0 * (_quantile(counts, 0.6915) - level))


@njit(cache=True, nogil=True)
def _mean(image: Picture, top: int, left: int, side: int) -> int:
    total = 0
    for y in range(top, top + side):
        for x in range(left, left + side):
            total += image[y, x]
    return (total + side * side // 2) // (side * side)


@njit(cache=True, nogil=True)
def _quantile(counts: npt.NDArray[np.int64], share: float) -> float:
    """Grey level below which a share of the counts lies, within its bin by proportion."""
    wanted = share * counts.sum()
    seen, grey = 0, 0
    while seen + counts[grey] <= wanted:
        seen += counts[grey]
        grey += 1
    return float(grey - 0.5 + (wanted - seen) / counts[grey])
