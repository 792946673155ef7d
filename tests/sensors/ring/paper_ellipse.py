"""Zhai et al.'s ellipse fit, for comparison with the one that flies."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rendezview.sensors.ring.ellipse import Ellipse


def fit_paper(points_px: npt.ArrayLike) -> Ellipse | None:
    """Zhai et al., eq. 4–8: least squares of ``x² + A xy + B y² + C x + D y + E``.

    Points (N, 2) px, N ≥ 5. None where that is no ellipse. Biased on arcs. Eq. 8 loses the sign
    of φ, which is that of -A.
    """
    points = np.asarray(points_px, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"points_px must be (N, 2) and finite, not {points.shape}")
    if len(points) < 5:
        return None
    origin, scale = points.mean(axis=0), float(points.std()) or 1.0
    x, y = ((points - origin) / scale).T
    solution, _, rank, _ = np.linalg.lstsq(
        np.column_stack([x * y, y * y, x, y, np.ones_like(x)]), -x * x, rcond=None
    )
    if rank < 5:
        return None
    big_a, big_b, c, d, e = solution
    divisor = big_a**2 - 4.0 * big_b
    if divisor >= 0.0:
        return None
    u = (2.0 * big_b * c - big_a * d) / divisor  # eq. 4
    v = (2.0 * d - big_a * c) / divisor  # eq. 5
    top = 2.0 * (big_a * c * d - big_b * c**2 - d**2 + 4.0 * big_b * e - big_a**2 * e)
    root = math.hypot(big_a, 1.0 - big_b)
    square_a = top / (divisor * (big_b - root + 1.0))  # eq. 6
    square_b = top / (divisor * (big_b + root + 1.0))  # eq. 7
    if not (square_a > 0.0 and square_b > 0.0):
        return None
    upper, lower = square_a - big_b * square_b, big_b * square_a - square_b
    phi = math.atan2(math.sqrt(max(upper, 0.0)), math.sqrt(max(lower, 0.0)))  # eq. 8
    phi = math.copysign(phi, -big_a)
    long, short = math.sqrt(square_a), math.sqrt(square_b)
    return Ellipse(origin + scale * np.array([u, v]), (scale * long, scale * short), phi)
