"""P3P: every pose that puts three known points on three rays, for one set or a batch.

Bales' three law-of-cosines equations, ``r1² + r2² − 2 r1 r2 cos θ12 = D12²`` and so on, written

    (r1 − r2)² + r1 r2 q12 = D12²,      q12 = |d1 − d2|² = 2 − 2 cos θ12

so that nothing cancels at long range. With ``r2 = r1 (1 + s X)``, ``r3 = r1 (1 + s Y)`` and
``q = s² Q`` two conics in (X, Y) remain, whose coefficients keep their size at any range. They
meet where a degenerate conic of their pencil, a pair of lines, meets any other (a cubic, a split,
two quadratics; Persson & Nordberg 2018, Ding et al. 2023). Of three real roots of the cubic the
most isolated is taken, which stays simple where two poses fall together. Newton steps on the
three equations then remove the rounding.

A camera in the plane of the points, as for a guidance target seen head-on, is no special case
here: only angles between rays enter.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.conic_pencil import (
    blend,
    determinant,
    isolated_root,
    meet,
    mixed_determinant,
    split_lines,
    unit_conic,
)
from rendezview.geometry.pose import Array

_Axes = tuple[float, float, float, float, float, float, float, float, float]
_Root = tuple[float, float, float, float]  # k, X, Y, error

Counts = npt.NDArray[np.int64]

MAX_ROOTS = 4  # poses. Source: Persson & Nordberg 2018, two conics meet in four points
# residual, in squares of the longest side, that a root of exact rays keeps below. Source: by
# construction, rounding
_EXACT = 1e-11


def solve_p3p_batch(rays: npt.ArrayLike, points_m: npt.ArrayLike) -> tuple[Array, Array, Counts]:
    """All poses ``camera_from_target`` of three points seen along three rays, for N sets of rays.

    Args:
        rays: (N, 3, 3) one ray a row, camera frame, any length.
        points_m: (3, 3) one point a row, target frame, not on one line; or (N, 3, 3), of each set.

    Returns:
        At most four poses with every point in front of the camera centre (along its ray):
        rotations (N, 4, 3, 3), translations (N, 4, 3) in metres, number of roots (N,). Rows
        past the number of roots are NaN; a set with NaN has no roots.

    Raises:
        ValueError: wrong shapes.
    """
    given = np.ascontiguousarray(rays, dtype=np.float64)
    points = np.ascontiguousarray(points_m, dtype=np.float64)
    if given.ndim != 3 or given.shape[1:] != (3, 3):
        raise ValueError(f"rays must be (N, 3, 3), not {given.shape}")
    if points.shape == (3, 3):
        points = points[None]
    if points.shape not in ((1, 3, 3), given.shape):
        raise ValueError(f"points must be (3, 3) or {given.shape}, not {points.shape}")
    rotations = np.full((len(given), MAX_ROOTS, 3, 3), np.nan)
    translations = np.full((len(given), MAX_ROOTS, 3), np.nan)
    counts = np.zeros(len(given), np.int64)
    _batch(given, points, rotations, translations, counts)
    return rotations, translations, counts


@njit(cache=True, nogil=True, error_model="numpy")
def _batch(
    rays: Array, points: Array, rotations: Array, translations: Array, counts: Counts
) -> None:
    for n in range(rays.shape[0]):
        model = points[n] if points.shape[0] > 1 else points[0]
        counts[n] = p3p_roots(rays[n], model, _EXACT, rotations[n], translations[n])


@njit(cache=True, nogil=True, error_model="numpy")
def p3p_roots(
    rays: Array, points: Array, residual: float, rotations: Array, translations: Array
) -> int:
    """`solve_p3p_batch` for other compiled code: fills (4, 3, 3) and (4, 3), returns the number.

    ``residual``: largest error of a squared side, over the longest squared. A larger one keeps what
    is left of two poses that noise has made one."""
    n0 = math.sqrt(rays[0, 0] ** 2 + rays[0, 1] ** 2 + rays[0, 2] ** 2)
    n1 = math.sqrt(rays[1, 0] ** 2 + rays[1, 1] ** 2 + rays[1, 2] ** 2)
    n2 = math.sqrt(rays[2, 0] ** 2 + rays[2, 1] ** 2 + rays[2, 2] ** 2)
    if not n0 * n1 * n2 > 0.0:
        return 0
    ax, ay, az = rays[0, 0] / n0, rays[0, 1] / n0, rays[0, 2] / n0
    bx, by, bz = rays[1, 0] / n1, rays[1, 1] / n1, rays[1, 2] / n1
    cx, cy, cz = rays[2, 0] / n2, rays[2, 1] / n2, rays[2, 2] / n2
    q12 = (ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2
    q13 = (ax - cx) ** 2 + (ay - cy) ** 2 + (az - cz) ** 2
    q23 = (bx - cx) ** 2 + (by - cy) ** 2 + (bz - cz) ** 2
    ux, uy, uz = _minus(points, 1, 0)
    vx, vy, vz = _minus(points, 2, 0)
    wx, wy, wz = _minus(points, 2, 1)
    d12 = ux * ux + uy * uy + uz * uz
    d13 = vx * vx + vy * vy + vz * vz
    d23 = wx * wx + wy * wy + wz * wz
    longest, widest = max(d12, d13, d23), max(q12, q13, q23)
    if not (longest > 0.0 and widest > 0.0):
        return 0
    s = math.sqrt(widest)
    sides = (d12 / longest, d13 / longest, d23 / longest)
    angles = (q12 / widest, q13 / widest, q23 / widest)
    model = _frame(ux, uy, uz, vx, vy, vz)
    if model[0] > 1.5:  # no triangle
        return 0
    count = 0
    for k, x, y, error in _ratios(sides, angles, s):
        if not (error <= residual and k > 0.0 and 1.0 + s * x > 0.0 and 1.0 + s * y > 0.0):
            continue
        r = math.sqrt(k * longest) / s  # distance of the first point
        # Differences of the three points, formed without subtracting the long distances.
        sx, sy = s * x, s * y
        e2x, e2y, e2z = r * (bx - ax + sx * bx), r * (by - ay + sx * by), r * (bz - az + sx * bz)
        e3x, e3y, e3z = r * (cx - ax + sy * cx), r * (cy - ay + sy * cy), r * (cz - az + sy * cz)
        axes = _frame(e2x, e2y, e2z, e3x, e3y, e3z)
        if axes[0] > 1.5:
            continue
        rotation, translation = rotations[count], translations[count]
        for i in range(3):
            for j in range(3):
                rotation[i, j] = (
                    axes[i] * model[j] + axes[3 + i] * model[3 + j] + axes[6 + i] * model[6 + j]
                )
        first = (r * ax, r * ay, r * az)
        for i in range(3):
            translation[i] = first[i] - (
                rotation[i, 0] * points[0, 0]
                + rotation[i, 1] * points[0, 1]
                + rotation[i, 2] * points[0, 2]
            )
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _minus(points: Array, i: int, j: int) -> tuple[float, float, float]:
    return points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _frame(ux: float, uy: float, uz: float, vx: float, vy: float, vz: float) -> _Axes:
    """Right-handed frame of two sides of a triangle, axis by axis; (2, 0, …) where it has none."""
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    u, n = math.sqrt(ux * ux + uy * uy + uz * uz), math.sqrt(nx * nx + ny * ny + nz * nz)
    if not (u > 0.0 and n > 0.0):
        return 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ux, uy, uz, nx, ny, nz = ux / u, uy / u, uz / u, nx / n, ny / n, nz / n
    return ux, uy, uz, ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy")
def _ratios(
    sides: tuple[float, float, float], angles: tuple[float, float, float], s: float
) -> tuple[_Root, _Root, _Root, _Root]:
    """Four candidates (k, X, Y, error), polished; k = s² r1² over the longest side squared.

    ``k (X² + (1 + s X) Q12) = D12²``, ``k (Y² + (1 + s Y) Q13) = D13²`` and
    ``k ((X − Y)² + (1 + s X)(1 + s Y) Q23) = D23²``.
    """
    d12, d13, d23 = sides
    q12, q13, q23 = angles
    nothing = (-1.0, 0.0, 0.0, np.inf)
    # Conics (xx, xy/2, yy, x/2, y/2, 1): k eliminated between the equations 1, 2 and 1, 3.
    a = unit_conic(
        (d13, 0.0, -d12, 0.5 * s * d13 * q12, -0.5 * s * d12 * q13, d13 * q12 - d12 * q13)
    )
    b = unit_conic(
        (
            d23 - d12,
            d12 - 0.5 * s * s * d12 * q23,
            -d12,
            0.5 * s * (d23 * q12 - d12 * q23),
            -0.5 * s * d12 * q23,
            d23 * q12 - d12 * q23,
        )
    )
    c0, c1 = determinant(a), mixed_determinant(a, b)
    c2, c3 = mixed_determinant(b, a), determinant(b)
    # Turn the pencil's basis so that the cubic keeps its leading term: a cubic form does not
    # vanish in four directions.
    best, cosine, sine = -1.0, 1.0, 0.0
    for direction in ((0.0, 1.0), (1.0, 0.0), (0.70710678118654752, 0.70710678118654752),
                      (-0.70710678118654752, 0.70710678118654752)):  # fmt: skip
        f, g = direction
        size = abs(c0 * f**3 + c1 * f * f * g + c2 * f * g * g + c3 * g**3)
        if size > best:
            best, cosine, sine = size, g, f
    if not best > 0.0:
        return nothing, nothing, nothing, nothing
    lead = blend(a, sine, b, cosine)
    other = blend(a, cosine, b, -sine)
    root = isolated_root(
        determinant(lead),
        mixed_determinant(lead, other),
        mixed_determinant(other, lead),
        determinant(other),
    )
    pair = blend(other, 1.0, lead, root)
    across = blend(other, -root, lead, 1.0)
    real, first, second = split_lines(pair)
    if not real:
        return nothing, nothing, nothing, nothing
    p0, p1 = meet(first, across)
    p2, p3 = meet(second, across)
    return (
        _polish(p0, sides, angles, s),
        _polish(p1, sides, angles, s),
        _polish(p2, sides, angles, s),
        _polish(p3, sides, angles, s),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _polish(
    point: tuple[float, float], sides: tuple[float, float, float],
    angles: tuple[float, float, float], s: float,
) -> _Root:  # fmt: skip
    """Newton on the three equations in (k, X, Y) for as long as the error falls."""
    x, y = point
    if not (math.isfinite(x) and math.isfinite(y)):
        return -1.0, 0.0, 0.0, np.inf
    d12, d13, d23 = sides
    q12, q13, q23 = angles
    e12, e13 = x * x + (1.0 + s * x) * q12, y * y + (1.0 + s * y) * q13
    e23 = (x - y) * (x - y) + (1.0 + s * x) * (1.0 + s * y) * q23
    k = (d12 + d13 + d23) / (e12 + e13 + e23)
    best = (k, x, y, np.inf)
    for _ in range(12):
        f12, f13, f23 = k * e12 - d12, k * e13 - d13, k * e23 - d23
        error = max(abs(f12), abs(f13), abs(f23))
        if not error < best[3]:
            break
        best = (k, x, y, error)
        if error < 1e-16:
            break
        # Rows of the Jacobian: (e12, g12, 0), (e13, 0, g13), (e23, g, h).
        g12, g13 = k * (2.0 * x + s * q12), k * (2.0 * y + s * q13)
        g = k * (2.0 * (x - y) + s * (1.0 + s * y) * q23)
        h = k * (2.0 * (y - x) + s * (1.0 + s * x) * q23)
        det = -e12 * g13 * g - g12 * (e13 * h - g13 * e23)
        if det == 0.0:
            break
        k -= (-f12 * g13 * g - g12 * (f13 * h - g13 * f23)) / det
        dx = (e12 * (f13 * h - g13 * f23) - f12 * (e13 * h - g13 * e23)) / det
        dy = (e12 * (-f13 * g) - g12 * (e13 * f23 - f13 * e23) + f12 * e13 * g) / det
        x -= dx
        y -= dy
        e12, e13 = x * x + (1.0 + s * x) * q12, y * y + (1.0 + s * y) * q13
        e23 = (x - y) * (x - y) + (1.0 + s * x) * (1.0 + s * y) * q23
    return best
