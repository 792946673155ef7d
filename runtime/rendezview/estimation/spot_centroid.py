"""Moments of a spot under a Gaussian window: the inner loop of every sub-pixel centroid.

The centroid of a spot is the point about which a Gaussian window of the spot's own size finds no
first moment. For a Gaussian spot in white noise this is the least-squares place: its error
σ_noise √(2/π) / peak an axis is the Cramér–Rao bound for any spot size.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

Grey = npt.NDArray[np.uint8]

# Numbers of the moments that `window_moments` gives
TOTAL, MX, MY, MXX, MYY, NORM, LEVER = range(7)
Moments = tuple[float, float, float, float, float, float, float]


@njit(cache=True, nogil=True)
def window_moments(
    image: Grey, dark: Grey, background: float, x: float, y: float, sigma: float,
    box: tuple[int, int, int, int], columns: Array, rows: Array,
) -> Moments:  # fmt: skip
    """Sums over a box of pixels, with w a Gaussian about (x, y) and v the grey above background.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        background: grey level to subtract.
        x, y, sigma: of the window, px.
        box: first and last column, first and last row, all inclusive.
        columns, rows: scratch, at least as long as the box is wide and high.

    Returns:
        Σ w v, Σ w v dx, Σ w v dy, Σ w v dx², Σ w v dy², Σ w², Σ w² (dx² + dy²) / 2.
    """
    x0, x1, y0, y1 = box
    has_dark = dark.shape[0] > 0
    f = -0.5 / (sigma * sigma)
    for u in range(x0, x1 + 1):
        columns[u - x0] = math.exp(f * (u - x) * (u - x))
    for v in range(y0, y1 + 1):
        rows[v - y0] = math.exp(f * (v - y) * (v - y))
    total = mx = my = mxx = myy = norm = lever = 0.0
    for v in range(y0, y1 + 1):
        dy, row = v - y, rows[v - y0]
        a = ax = axx = q = qxx = 0.0
        for u in range(x0, x1 + 1):
            value = float(image[v, u]) - background
            if has_dark:
                value -= dark[v, u]
            w, dx = columns[u - x0], u - x
            wv = w * value
            a += wv
            ax += wv * dx
            axx += wv * dx * dx
            q += w * w
            qxx += w * w * dx * dx
        total += row * a
        mx += row * ax
        my += row * a * dy
        mxx += row * axx
        myy += row * a * dy * dy
        norm += row * row * q
        lever += row * row * 0.5 * (qxx + q * dy * dy)
    return total, mx, my, mxx, myy, norm, lever
