"""Conics as six numbers, and where two of them meet: the algebra of P3P.

A conic is (xx, xy/2, yy, x/2, y/2, 1), the symmetric matrix [[c0, c1, c3], [c1, c2, c4],
[c3, c4, c5]]. Persson & Nordberg 2018; Ding et al. 2023.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

Conic = tuple[float, float, float, float, float, float]
Line = tuple[float, float, float]  # l0 X + l1 Y + l2 = 0
Point = tuple[float, float]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def unit_conic(c: Conic) -> Conic:
    """The conic scaled to a largest coefficient of 1."""
    f = 1.0 / max(abs(c[0]), abs(c[1]), abs(c[2]), abs(c[3]), abs(c[4]), abs(c[5]), 1e-300)
    return c[0] * f, c[1] * f, c[2] * f, c[3] * f, c[4] * f, c[5] * f


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def blend(a: Conic, f: float, b: Conic, g: float) -> Conic:
    """f a + g b."""
    return (
        f * a[0] + g * b[0],
        f * a[1] + g * b[1],
        f * a[2] + g * b[2],
        f * a[3] + g * b[3],
        f * a[4] + g * b[4],
        f * a[5] + g * b[5],
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def adjugate(c: Conic) -> Conic:
    """Of [[c0, c1, c3], [c1, c2, c4], [c3, c4, c5]], in the same order (00 01 11 02 12 22)."""
    return (
        c[2] * c[5] - c[4] * c[4],
        c[3] * c[4] - c[1] * c[5],
        c[0] * c[5] - c[3] * c[3],
        c[1] * c[4] - c[2] * c[3],
        c[1] * c[3] - c[0] * c[4],
        c[0] * c[2] - c[1] * c[1],
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def determinant(c: Conic) -> float:
    """Of the conic's matrix; 0 where it is degenerate, a pair of lines."""
    m = adjugate(c)
    return c[0] * m[0] + c[1] * m[1] + c[3] * m[3]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def mixed_determinant(a: Conic, b: Conic) -> float:
    """tr(adj(a) b): the coefficient of a² b in det(a + b)."""
    m = adjugate(a)
    return m[0] * b[0] + m[2] * b[2] + m[5] * b[5] + 2.0 * (m[1] * b[1] + m[3] * b[3] + m[4] * b[4])


@njit(cache=True, nogil=True, error_model="numpy")
def isolated_root(c3: float, c2: float, c1: float, c0: float) -> float:
    """The real root of a cubic that is farthest from the others; c3 is not 0."""
    b, c, d = c2 / c3, c1 / c3, c0 / c3
    p, q = c - b * b / 3.0, b * (2.0 * b * b / 9.0 - c) / 3.0 + d
    disc = 0.25 * q * q + p * p * p / 27.0
    if disc >= 0.0:
        h = -0.5 * q - math.copysign(math.sqrt(disc), q)
        u = math.copysign(abs(h) ** (1.0 / 3.0), h)
        x = u - p / (3.0 * u) if u != 0.0 else 0.0
    else:
        # Roots 2 m cos(φ + k 120°): the extreme one on the side of the wider gap.
        m = math.sqrt(-p / 3.0)
        phi = math.acos(min(max(0.5 * abs(q) / (m * m * m), -1.0), 1.0)) / 3.0
        x = -math.copysign(2.0 * m * math.cos(phi), q)
    x -= b / 3.0
    for _ in range(2):
        slope = (3.0 * x + 2.0 * b) * x + c
        if slope == 0.0:
            break
        x -= (((x + b) * x + c) * x + d) / slope
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def split_lines(c: Conic) -> tuple[bool, Line, Line]:
    """A degenerate conic as two lines (l0 X + l1 Y + l2 = 0); false where they are not real."""
    m = adjugate(c)
    largest = max(abs(m[0]), abs(m[2]), abs(m[5]))
    p0 = p1 = p2 = 0.0
    if largest > 1e-30:
        # adj(c) = −p pᵀ, p where the lines meet
        if m[0] <= m[2] and m[0] <= m[5]:
            if m[0] >= 0.0:
                return False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            f = 1.0 / math.sqrt(-m[0])
            p0, p1, p2 = m[0] * f, m[1] * f, m[3] * f
        elif m[2] <= m[5]:
            if m[2] >= 0.0:
                return False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            f = 1.0 / math.sqrt(-m[2])
            p0, p1, p2 = m[1] * f, m[2] * f, m[4] * f
        else:
            if m[5] >= 0.0:
                return False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            f = 1.0 / math.sqrt(-m[5])
            p0, p1, p2 = m[3] * f, m[4] * f, m[5] * f
    # c + [p]× has rank one: its row and its column are the lines.
    r0 = (c[0], c[1] - p2, c[3] + p1)
    r1 = (c[1] + p2, c[2], c[4] - p0)
    r2 = (c[3] - p1, c[4] + p0, c[5])
    l0 = max(abs(r0[0]), abs(r0[1]), abs(r0[2]))
    l1 = max(abs(r1[0]), abs(r1[1]), abs(r1[2]))
    l2 = max(abs(r2[0]), abs(r2[1]), abs(r2[2]))
    row = r0
    if l1 > l0 and l1 >= l2:
        row = r1
    elif l2 > l0:
        row = r2
    if abs(row[0]) >= abs(row[1]) and abs(row[0]) >= abs(row[2]):
        column = (r0[0], r1[0], r2[0])
    elif abs(row[1]) >= abs(row[2]):
        column = (r0[1], r1[1], r2[1])
    else:
        column = (r0[2], r1[2], r2[2])
    return True, row, column


@njit(cache=True, nogil=True, error_model="numpy")
def meet(line: Line, c: Conic) -> tuple[Point, Point]:
    """Where a line meets a conic: two points (X, Y); NaN where they are clearly complex."""
    l0, l1, l2 = line
    none = (np.nan, np.nan)
    if abs(l0) >= abs(l1):
        if l0 == 0.0:
            return none, none
        f, g = -l1 / l0, -l2 / l0  # X = f Y + g
        a = c[0] * f * f + 2.0 * c[1] * f + c[2]
        b = c[0] * f * g + c[1] * g + c[3] * f + c[4]
        d = c[0] * g * g + 2.0 * c[3] * g + c[5]
        t0, t1 = _quadratic(a, b, d)
        return (f * t0 + g, t0), (f * t1 + g, t1)
    f, g = -l0 / l1, -l2 / l1  # Y = f X + g
    a = c[2] * f * f + 2.0 * c[1] * f + c[0]
    b = c[2] * f * g + c[1] * g + c[4] * f + c[3]
    d = c[2] * g * g + 2.0 * c[4] * g + c[5]
    t0, t1 = _quadratic(a, b, d)
    return (t0, f * t0 + g), (t1, f * t1 + g)


@njit(cache=True, nogil=True, error_model="numpy")
def _quadratic(a: float, b: float, c: float) -> tuple[float, float]:
    """Roots of a t² + 2 b t + c, a pair that is nearly real as its real part and NaN."""
    disc = b * b - a * c
    if disc <= 0.0:
        if disc < -0.05 * (b * b + abs(a * c)) or a == 0.0:
            return np.nan, np.nan
        return -b / a, np.nan
    h = -(b + math.copysign(math.sqrt(disc), b))
    return (h / a if a != 0.0 else np.nan), (c / h if h != 0.0 else 0.0)
