"""The smallest sphere around a set of points."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from rendezview.geometry.pose import Array

_MAX_ROUNDS = 1000  # ten to twenty are usual


def smallest_enclosing_sphere(points: Array) -> tuple[Array, float]:
    """The smallest sphere that encloses all points.

    An active-set method: the sphere of at most four points is enlarged by the farthest point
    outside, until no point is outside. The radius grows strictly, so the loop ends. The result is
    exact up to rounding.

    Args:
        points: (N, 3), finite, N >= 1.

    Returns:
        Centre (3,) and radius, in the unit of the points; no point is outside.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be (N, 3) with N >= 1, not {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError("points must be finite")
    offset = 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = float(np.abs(points - offset).max())
    if scale == 0.0:
        return offset, float(np.linalg.norm(points - offset, axis=1).max())
    unit = (points - offset) / scale  # well-conditioned for any unit
    basis = unit[[int(np.argmax(np.linalg.norm(unit, axis=1)))]]
    centre, radius = basis[0], 0.0
    for _ in range(_MAX_ROUNDS):
        distance = np.linalg.norm(unit - centre, axis=1)
        farthest = int(np.argmax(distance))
        if distance[farthest] <= radius * (1.0 + 1e-12) + 1e-15:
            break
        larger = _sphere_of_few(np.vstack([unit[farthest], basis]))
        if larger[1] <= radius:  # no progress, because of rounding
            break
        centre, radius, basis = larger
    centre = centre * scale + offset
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _sphere_of_few(points: Array) -> tuple[Array, float, Array]:
    """Smallest enclosing sphere of at most five points, and the points that define it."""
    best: tuple[Array, float, Array] | None = None
    for size in range(1, min(4, len(points)) + 1):
        for chosen in combinations(range(len(points)), size):
            basis = points[list(chosen)]
            centre = _circumcentre(basis)
            radius = float(np.linalg.norm(basis - centre, axis=1).max())
            encloses = np.linalg.norm(points - centre, axis=1).max() <= radius * (1 + 1e-10)
            if encloses and (best is None or radius < best[1]):
                best = centre, radius, basis
    if best is None:  # points coplanar up to rounding: a safe sphere
        centre = points.mean(axis=0)
        return centre, float(np.linalg.norm(points - centre, axis=1).max()), points[:4]
    return best


def _circumcentre(points: Array) -> Array:
    """Centre equidistant from the points, in their affine hull: 2 (p_i − p_0)·c = |p_i − p_0|²."""
    edges = points[1:] - points[0]
    if len(edges) == 0:
        centre: Array = points[0]
        return centre
    solution = np.linalg.lstsq(2.0 * edges, (edges**2).sum(axis=1), rcond=None)[0]
    equidistant: Array = points[0] + solution
    return equidistant
