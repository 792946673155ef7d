"""Conics as compiled loops use them: sums of moments, the direct ellipse fit, distances.

The direct fit (Fitzgibbon, Pilu & Fisher 1999, in the form of Halír & Flusser 1998) always gives
an ellipse, as a search for ellipses needs. It is biased on short arcs, so its result is only the
start of `Ellipse.fit` and of the search.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

SCATTER = 15  # moments x^i y^j, i + j <= 4. Source: by construction


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def add_point(sums: Array, x: float, y: float) -> None:
    """Add a point to the moments: x⁴ x³y x²y² xy³ y⁴, x³ x²y xy² y³, x² xy y², x y, 1."""
    xx, xy, yy = x * x, x * y, y * y
    sums[0] += xx * xx
    sums[1] += xx * xy
    sums[2] += xx * yy
    sums[3] += xy * yy
    sums[4] += yy * yy
    sums[5] += xx * x
    sums[6] += xx * y
    sums[7] += x * yy
    sums[8] += yy * y
    sums[9] += xx
    sums[10] += xy
    sums[11] += yy
    sums[12] += x
    sums[13] += y
    sums[14] += 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def conic_of(sums: Array, conic: Array) -> bool:
    """The direct fit's conic (6,) A x² + B xy + C y² + D x + E y + F; False where there is none."""
    s = sums
    # S3 of (x, y, 1), its inverse
    a, b, c, d, e, f = s[9], s[10], s[12], s[11], s[13], s[14]
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * m00 + b * m01 + c * m02
    if abs(determinant) < 1e-18 * (abs(a * m00) + abs(b * m01) + abs(c * m02)) + 1e-300:
        return False
    inverse = 1.0 / determinant
    s2 = np.empty((3, 3))  # (x², xy, y²) with (x, y, 1)
    s2[0, 0], s2[0, 1], s2[0, 2] = s[5], s[6], s[9]
    s2[1, 0], s2[1, 1], s2[1, 2] = s[6], s[7], s[10]
    s2[2, 0], s2[2, 1], s2[2, 2] = s[7], s[8], s[11]
    t = np.empty((3, 3))  # -S3⁻¹ S2ᵀ: linear part from the quadratic one
    for k in range(3):
        p, q, r = s2[k, 0], s2[k, 1], s2[k, 2]
        t[0, k] = -(m00 * p + m01 * q + m02 * r) * inverse
        t[1, k] = -(m01 * p + m11 * q + m12 * r) * inverse
        t[2, k] = -(m02 * p + m12 * q + m22 * r) * inverse
    r00 = s[0] + s2[0, 0] * t[0, 0] + s2[0, 1] * t[1, 0] + s2[0, 2] * t[2, 0]
    r01 = s[1] + s2[0, 0] * t[0, 1] + s2[0, 1] * t[1, 1] + s2[0, 2] * t[2, 1]
    r02 = s[2] + s2[0, 0] * t[0, 2] + s2[0, 1] * t[1, 2] + s2[0, 2] * t[2, 2]
    r11 = s[2] + s2[1, 0] * t[0, 1] + s2[1, 1] * t[1, 1] + s2[1, 2] * t[2, 1]
    r12 = s[3] + s2[1, 0] * t[0, 2] + s2[1, 1] * t[1, 2] + s2[1, 2] * t[2, 2]
    r22 = s[4] + s2[2, 0] * t[0, 2] + s2[2, 1] * t[1, 2] + s2[2, 2] * t[2, 2]
    found, q0, q1, q2 = _quadratic_part(r00, r01, r02, r11, r12, r22)
    if not found:
        return False
    conic[0], conic[1], conic[2] = q0, q1, q2
    for k in range(3):
        conic[3 + k] = t[k, 0] * q0 + t[k, 1] * q1 + t[k, 2] * q2
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _quadratic_part(
    r00: float, r01: float, r02: float, r11: float, r12: float, r22: float
) -> tuple[bool, float, float, float]:
    """Whether there is a q with R q = λ C q and 4 q0 q2 - q1² = 1, and its unit vector.

    With R = L Lᵀ it belongs to the largest eigenvalue of L⁻¹ C L⁻ᵀ, its only positive one.
    """
    tiny = 1e-13 * (r00 + r11 + r22)
    if not r00 > tiny:
        return False, 0.0, 0.0, 0.0
    l00 = np.sqrt(r00)
    l10, l20 = r01 / l00, r02 / l00
    w = r11 - l10 * l10
    if not w > 0.0:
        return False, 0.0, 0.0, 0.0
    l11 = np.sqrt(w)
    l21 = (r12 - l20 * l10) / l11
    w = r22 - l20 * l20 - l21 * l21
    if not w > 0.0:
        return False, 0.0, 0.0, 0.0
    l22 = np.sqrt(w)
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    # A = L⁻¹ C L⁻ᵀ with C = ((0, 0, 2), (0, -1, 0), (2, 0, 0)); rows of L⁻¹: (i00 0 0) …
    a00 = 0.0
    a01 = 0.0
    a02 = 2.0 * i00 * i22
    a11 = -i11 * i11
    a12 = 2.0 * i10 * i22 - i11 * i21
    a22 = 4.0 * i20 * i22 - i21 * i21
    value = _largest(a00, a01, a02, a11, a12, a22)
    if not value > 0.0:
        return False, 0.0, 0.0, 0.0
    best, v0, v1, v2 = _eigenvector(a00, a01, a02, a11, a12, a22, value)
    if best <= 0.0:
        return False, 0.0, 0.0, 0.0
    q0 = i00 * v0 + i10 * v1 + i20 * v2
    q1 = i11 * v1 + i21 * v2
    q2 = i22 * v2
    size = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
    if not size > 0.0:
        return False, 0.0, 0.0, 0.0
    return True, q0 / size, q1 / size, q2 / size


@njit(cache=True, nogil=True, error_model="numpy")
def _eigenvector(
    a00: float, a01: float, a02: float, a11: float, a12: float, a22: float, value: float
) -> tuple[float, float, float, float]:
    """Squared length and components of an eigenvector of a symmetric 3 × 3 matrix A.

    It is the largest cross product of two rows of A - value I.
    """
    b00, b11, b22 = a00 - value, a11 - value, a22 - value
    best, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        if k == 0:
            c0, c1, c2 = a01 * a12 - a02 * b11, a02 * a01 - b00 * a12, b00 * b11 - a01 * a01
        elif k == 1:
            c0, c1, c2 = a01 * b22 - a02 * a12, a02 * a02 - b00 * b22, b00 * a12 - a01 * a02
        else:
            c0, c1, c2 = b11 * b22 - a12 * a12, a12 * a02 - a01 * b22, a01 * a12 - b11 * a02
        size = c0 * c0 + c1 * c1 + c2 * c2
        if size > best:
            best, v0, v1, v2 = size, c0, c1, c2
    return best, v0, v1, v2


@njit(cache=True, nogil=True, error_model="numpy")
def _largest(a00: float, a01: float, a02: float, a11: float, a12: float, a22: float) -> float:
    """Largest eigenvalue of a symmetric 3 × 3 matrix."""
    mean = (a00 + a11 + a22) / 3.0
    off = a01 * a01 + a02 * a02 + a12 * a12
    p2 = (a00 - mean) ** 2 + (a11 - mean) ** 2 + (a22 - mean) ** 2 + 2.0 * off
    if p2 <= 0.0:
        return mean
    p = np.sqrt(p2 / 6.0)
    b00, b11, b22 = (a00 - mean) / p, (a11 - mean) / p, (a22 - mean) / p
    b01, b02, b12 = a01 / p, a02 / p, a12 / p
    half = 0.5 * (
        b00 * (b11 * b22 - b12 * b12) - b01 * (b01 * b22 - b12 * b02)
        + b02 * (b01 * b12 - b11 * b02)
    )  # fmt: skip
    return float(mean + 2.0 * p * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3.0))


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
