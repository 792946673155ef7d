"""Conics as compiled loops use them: sums of moments, a fit, distances.

The fit is linear least squares of the equation with A + C = 1, which does not depend on where the
points lie and how they are turned. Its result is only the start of a search.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import solve

Array = npt.NDArray[np.float64]

MOMENTS = 6  # rows of `add_point`'s sums. Source: by construction


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def add_point(sums: Array, x: float, y: float) -> None:
    """Add a point to the sums (6, 6) of products of x² - y², xy, x, y, 1 and -(x² + y²) / 2."""
    row = (x * x - y * y, x * y, x, y, 1.0, -0.5 * (x * x + y * y))
    for i in range(MOMENTS):
        for j in range(i + 1):
            sums[i, j] += row[i] * row[j]


@njit(cache=True, nogil=True, error_model="numpy")
def conic_of(sums: Array, conic: Array) -> bool:
    """The fit's conic (6,) A x² + B xy + C y² + D x + E y + F; False where there is none."""
    a = np.empty(5)
    if not solve(sums[:5, :5], sums[5, :5], np.empty((5, 5)), a):
        return False
    conic[0], conic[1], conic[2] = 0.5 + a[0], a[1], 0.5 - a[0]
    conic[3], conic[4], conic[5] = a[2], a[3], a[4]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def ellipse_of_conic(conic: Array, shape: Array) -> bool:
    """The shape vector (5,) of a conic, see `ellipse`; False where it is no ellipse."""
    a, b, c, d, e, f = conic[0], conic[1], conic[2], conic[3], conic[4], conic[5]
    discriminant = 4.0 * a * c - b * b
    if not discriminant > 1e-14 * (a * a + b * b + c * c):
        return False
    x, y = (b * e - 2.0 * c * d) / discriminant, (b * d - 2.0 * a * e) / discriminant
    scale = -4.0 * (f + 0.5 * (d * x + e * y)) / discriminant
    shape[0], shape[1] = x, y
    return root_into(scale * c, -0.5 * scale * b, scale * a, shape) and bool(np.isfinite(x * y))


@njit(cache=True, nogil=True, error_model="numpy")
def root_into(s00: float, s01: float, s11: float, shape: Array) -> bool:
    """Numbers 2 to 4 of a shape: the root of a symmetric 2 × 2 matrix; False if not positive."""
    determinant = s00 * s11 - s01 * s01
    if not (determinant > 0.0 and s00 > 0.0):
        return False
    root = np.sqrt(determinant)
    size = np.sqrt(s00 + s11 + 2.0 * root)
    shape[2], shape[3], shape[4] = (s00 + root) / size, s01 / size, (s11 + root) / size
    return bool(np.isfinite(size))


@njit(cache=True, nogil=True, error_model="numpy")
def semi_axes(shape: Array) -> tuple[float, float]:
    """Long and short semi-axis of a shape."""
    half, off = 0.5 * (shape[2] + shape[4]), 0.5 * (shape[2] - shape[4])
    root = np.sqrt(off * off + shape[3] * shape[3])
    return half + root, half - root


@njit(cache=True, nogil=True, error_model="numpy")
def within(shape: Array, limits: Array) -> bool:
    """Whether axes keep the least short one, the largest long one and the least ratio of both."""
    long, short = semi_axes(shape)
    return bool(short >= limits[0] and long <= limits[1] and short >= limits[2] * long)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def distance(shape: Array, x: float, y: float) -> float:
    """Distance of a point from a shape to first order, outside positive; exact for circles."""
    a, b, c = shape[2], shape[3], shape[4]
    ex, ey = x - shape[0], y - shape[1]
    determinant = a * c - b * b
    v0, v1 = (c * ex - b * ey) / determinant, (a * ey - b * ex) / determinant
    g0, g1 = (c * v0 - b * v1) / determinant, (a * v1 - b * v0) / determinant
    size = np.sqrt(v0 * v0 + v1 * v1)
    return float((size - 1.0) * size / (np.sqrt(g0 * g0 + g1 * g1) + 1e-300))
