"""Bales' two iterations for the distances of the three reflectors.

``D`` is the distance from the post's tip to either outer reflector, ``L`` that between the outer
two, ``H`` the height of the post; reflector 1 is the tip, 2 and 3 the outer ones. Both methods
find one answer, that with the post towards the camera. They report a failure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, Pose

Bools = npt.NDArray[np.bool_]
Counts = npt.NDArray[np.int64]


class Iteration(StrEnum):
    """Bales' two methods."""

    NEWTON = "newton"  # Newton–Raphson from the mid-point assumption
    ALTERNATE = "alternate"  # three distances in turn, from right triangles


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Distances from the camera centre, and how they were reached."""

    distances_m: Array  # (3,) tip, left, right
    iterations: int
    converged: bool
    residual: float  # largest error of the three equations over L²


def newton_raphson(
    rays: npt.ArrayLike, base_m: float, post_m: float, *, most: int = 30, tolerance: float = 1e-13
) -> Triangulation:
    """The three law-of-cosines equations by Newton–Raphson, from the mid-point assumption.

    The base's middle is assumed to appear midway between the outer spots: that gives the
    distance of the outer reflectors, and the post's tip is the nearer of two points on its ray
    at H from that middle.

    Args:
        rays: (3, 3) of tip, left and right reflector, camera frame.
        base_m, post_m: L and H.
        most: iterations.
        tolerance: change of a distance, relative, that ends the iteration.

    Raises:
        ValueError: rays not (3, 3) and finite, or a length not positive.
    """
    return _one(rays, base_m, post_m, most, tolerance, 0)


def alternate_iteration(
    rays: npt.ArrayLike, base_m: float, post_m: float, *, most: int = 2000,
    tolerance: float = 1e-13,
) -> Triangulation:  # fmt: skip
    """Bales' alternate method, three distances in turn from right triangles.

    ``r2 = r1 cos θ12 + √(D² − r1² sin² θ12)``, ``r3 = r2 cos θ23 + √(L² − r2² sin² θ23)``,
    ``r1 = r3 cos θ13 − √(D² − r3² sin² θ13)`` from ``r1 = (L/2) cot(θ23/2)``; 2 and 3 exchanged
    where θ12 < θ13. As printed the first radicands are negative in nearly all cases; here they
    are taken as 0 then. That reaches the truth in most cases, not in all.
    """
    return _one(rays, base_m, post_m, most, tolerance, 1)


def triangulate_batch(
    rays: npt.ArrayLike, base_m: float, post_m: float, *, alternate: bool = False
) -> tuple[Array, Counts, Bools]:
    """Either method for (N, 3, 3) rays: distances (N, 3), iterations (N,), converged (N,)."""
    given = np.ascontiguousarray(rays, dtype=np.float64)
    if given.ndim != 3 or given.shape[1:] != (3, 3):
        raise ValueError(f"rays must be (N, 3, 3), not {given.shape}")
    distances, counts = np.empty((len(given), 3)), np.empty(len(given), np.int64)
    residuals = np.empty(len(given))
    most = 2000 if alternate else 30
    _batch(given, base_m, post_m, most, 1e-13, int(alternate), distances, counts, residuals)
    return distances, counts, (counts < most) & (residuals < 1e-9)


def pose_from_distances(
    rays: npt.ArrayLike, distances_m: npt.ArrayLike, points_m: npt.ArrayLike
) -> Pose:
    """The pose that carries three target points (3, 3) to these distances along their rays.

    Raises:
        ValueError: the points are on a line.
    """
    directions = np.asarray(rays, dtype=np.float64)
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    on_rays = directions * np.asarray(distances_m, dtype=np.float64)[:, None]
    points = np.asarray(points_m, dtype=np.float64)
    frames = []
    for corners in (on_rays, points):
        x, v = corners[2] - corners[1], corners[0] - corners[1]
        z = np.cross(x, v)
        if np.linalg.norm(z) <= 1e-9 * (x @ x):
            raise ValueError("three points on a line have no attitude")
        x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
        frames.append(np.column_stack([x, np.cross(z, x), z]))
    rotation = frames[0] @ frames[1].T
    return Pose(rotation, on_rays.mean(axis=0) - rotation @ points.mean(axis=0))


def _one(
    rays: npt.ArrayLike, base_m: float, post_m: float, most: int, tolerance: float, method: int
) -> Triangulation:
    given = np.ascontiguousarray(rays, dtype=np.float64)
    if given.shape != (3, 3) or not np.isfinite(given).all():
        raise ValueError(f"rays must be (3, 3) and finite, not {given.tolist()}")
    if not (base_m > 0.0 and post_m > 0.0):
        raise ValueError(f"base and post must be longer than 0: {base_m}, {post_m}")
    distances, counts, residuals = np.empty((1, 3)), np.empty(1, np.int64), np.empty(1)
    _batch(given[None], base_m, post_m, most, tolerance, method, distances, counts, residuals)
    converged = bool(counts[0] < most and residuals[0] < 1e-9)
    return Triangulation(distances[0], int(counts[0]), converged, float(residuals[0]))


@njit(cache=True, nogil=True)
def _batch(
    rays: Array, base: float, post: float, most: int, tolerance: float, method: int,
    distances: Array, counts: Counts, residuals: Array,
) -> None:  # fmt: skip
    d = np.empty((3, 3))
    side2, base2 = 0.25 * base * base + post * post, base * base
    for n in range(rays.shape[0]):
        for i in range(3):
            norm = math.sqrt(rays[n, i, 0] ** 2 + rays[n, i, 1] ** 2 + rays[n, i, 2] ** 2)
            for j in range(3):
                d[i, j] = rays[n, i, j] / norm
        # q = 2 − 2 cos θ, which keeps its digits at small angles
        q12, q13, q23 = _chord2(d, 0, 1), _chord2(d, 0, 2), _chord2(d, 1, 2)
        if not q23 > 0.0:
            counts[n], residuals[n], distances[n] = most, np.inf, np.nan
            continue
        if method == 0:
            r1, r2, r3, used = _newton(d, q12, q13, q23, base, post, side2, most, tolerance)
        else:
            r1, r2, r3, used = _alternate(q12, q13, q23, base, side2, most, tolerance)
        f12 = (r1 - r2) ** 2 + r1 * r2 * q12 - side2
        f13 = (r1 - r3) ** 2 + r1 * r3 * q13 - side2
        f23 = (r2 - r3) ** 2 + r2 * r3 * q23 - base2
        residuals[n] = max(abs(f12), abs(f13), abs(f23)) / base2
        if not (r1 > 0.0 and r2 > 0.0 and r3 > 0.0 and math.isfinite(residuals[n])):
            residuals[n] = np.inf
        counts[n] = used
        distances[n, 0], distances[n, 1], distances[n, 2] = r1, r2, r3


@njit(cache=True, nogil=True)
def _chord2(d: Array, i: int, j: int) -> float:
    return float((d[i, 0] - d[j, 0]) ** 2 + (d[i, 1] - d[j, 1]) ** 2 + (d[i, 2] - d[j, 2]) ** 2)


@njit(cache=True, nogil=True)
def _newton(
    d: Array, q12: float, q13: float, q23: float, base: float, post: float, side2: float,
    most: int, tolerance: float,
) -> tuple[float, float, float, int]:  # fmt: skip
    half = math.sqrt(0.25 * q23)  # sin(θ23/2)
    r2 = r3 = 0.5 * base / half
    middle = r2 * math.sqrt(1.0 - half * half)
    mx, my, mz = d[1, 0] + d[2, 0], d[1, 1] + d[2, 1], d[1, 2] + d[2, 2]
    m = math.sqrt(mx * mx + my * my + mz * mz)
    cosine = (mx * d[0, 0] + my * d[0, 1] + mz * d[0, 2]) / m
    sine2 = max(1.0 - cosine * cosine, 0.0)
    r1 = middle * cosine - math.sqrt(max(post * post - middle * middle * sine2, 0.0))
    base2 = base * base
    used = most
    for k in range(most):
        f12 = (r1 - r2) ** 2 + r1 * r2 * q12 - side2
        f13 = (r1 - r3) ** 2 + r1 * r3 * q13 - side2
        f23 = (r2 - r3) ** 2 + r2 * r3 * q23 - base2
        a1, a2 = 2.0 * (r1 - r2) + r2 * q12, 2.0 * (r2 - r1) + r1 * q12
        b1, b3 = 2.0 * (r1 - r3) + r3 * q13, 2.0 * (r3 - r1) + r1 * q13
        c2, c3 = 2.0 * (r2 - r3) + r3 * q23, 2.0 * (r3 - r2) + r2 * q23
        # [[a1, a2, 0], [b1, 0, b3], [0, c2, c3]]
        det = -a1 * b3 * c2 - a2 * b1 * c3
        if det == 0.0 or not math.isfinite(det):
            break
        s1 = (-f12 * b3 * c2 - a2 * (f13 * c3 - b3 * f23)) / det
        s2 = (a1 * (f13 * c3 - b3 * f23) - f12 * b1 * c3) / det
        s3 = (-a1 * f13 * c2 - a2 * b1 * f23 + f12 * b1 * c2) / det
        r1, r2, r3 = r1 - s1, r2 - s2, r3 - s3
        if abs(s1) + abs(s2) + abs(s3) < tolerance * (abs(r1) + abs(r2) + abs(r3)):
            used = k + 1
            break
    return r1, r2, r3, used


@njit(cache=True, nogil=True)
def _alternate(
    q12: float, q13: float, q23: float, base: float, side2: float, most: int, tolerance: float
) -> tuple[float, float, float, int]:
    swapped = q12 < q13
    if swapped:
        q12, q13 = q13, q12
    c12, c13, c23 = 1.0 - 0.5 * q12, 1.0 - 0.5 * q13, 1.0 - 0.5 * q23
    # sin² θ = q (1 − q/4)
    s12, s13, s23 = q12 * (1 - 0.25 * q12), q13 * (1 - 0.25 * q13), q23 * (1 - 0.25 * q23)
    half = math.sqrt(0.25 * q23)
    r1 = 0.5 * base * math.sqrt(1.0 - half * half) / half
    r2 = r3 = 0.0
    used = most
    for k in range(most):
        r2 = r1 * c12 + math.sqrt(max(side2 - r1 * r1 * s12, 0.0))
        r3 = r2 * c23 + math.sqrt(max(base * base - r2 * r2 * s23, 0.0))
        last = r1
        r1 = r3 * c13 - math.sqrt(max(side2 - r3 * r3 * s13, 0.0))
        if abs(r1 - last) < tolerance * abs(r1):
            used = k + 1
            break
    if swapped:
        r2, r3 = r3, r2
    return r1, r2, r3, used
