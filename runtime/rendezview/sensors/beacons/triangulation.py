"""Bales' two iterations for the distances of the three reflectors.

``D`` is the distance from the post's tip to either outer reflector, ``L`` that between the outer
two, ``H`` the height of the post; reflector 1 is the tip, 2 and 3 the outer ones. Both methods
find one answer, that with the post towards the camera. They report a failure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.estimation.least_squares import ROUNDING
from rendezview.geometry.pose import Array, Pose

Squares = tuple[float, float, float]  # of the chords between unit rays: tip, left; …, right; outer
# From these, L, H and the cosine between the tip and the middle of the outer two, with a bound of
# iterations: the distances and the iterations used.
Method = Callable[[Squares, float, float, float, int], tuple[Array, int]]


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


def newton_raphson(rays: npt.ArrayLike, base_m: float, post_m: float) -> Triangulation:
    """The three law-of-cosines equations by Newton–Raphson, from the mid-point assumption.

    The base's middle is assumed to appear midway between the outer spots: that gives the
    distance of the outer reflectors, and the post's tip is the nearer of two points on its ray
    at H from that middle.

    Args:
        rays: (3, 3) of tip, left and right reflector, camera frame.
        base_m, post_m: L and H.

    Raises:
        ValueError: rays not (3, 3) and finite, or a length not positive.
    """
    return _one(rays, base_m, post_m, 30, _newton)


def alternate_iteration(rays: npt.ArrayLike, base_m: float, post_m: float) -> Triangulation:
    """Bales' alternate method, three distances in turn from right triangles.

    ``r2 = r1 cos θ12 + √(D² − r1² sin² θ12)``, ``r3 = r2 cos θ23 + √(L² − r2² sin² θ23)``,
    ``r1 = r3 cos θ13 − √(D² − r3² sin² θ13)`` from ``r1 = (L/2) cot(θ23/2)``; 2 and 3 exchanged
    where θ12 < θ13. As printed the first radicands are negative in nearly all cases; here they
    are taken as 0 then. That reaches the truth in most cases, not in all.
    """
    return _one(rays, base_m, post_m, 2000, _alternate)


def pose_from_distances(
    rays: npt.ArrayLike, distances_m: npt.ArrayLike, points_m: npt.ArrayLike
) -> Pose:
    """The pose that carries a triangle of the target (3, 3) to these distances along its rays."""
    directions = np.asarray(rays, dtype=np.float64)
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    on_rays = directions * np.asarray(distances_m, dtype=np.float64)[:, None]
    points = np.asarray(points_m, dtype=np.float64)
    here, there = on_rays.mean(axis=0), points.mean(axis=0)
    rotation = Rotation.align_vectors(on_rays - here, points - there)[0].as_matrix()
    return Pose(rotation, here - rotation @ there)


def _one(
    rays: npt.ArrayLike, base_m: float, post_m: float, most: int, method: Method
) -> Triangulation:
    given = np.asarray(rays, dtype=np.float64)
    if given.shape != (3, 3) or not np.isfinite(given).all():
        raise ValueError(f"rays must be (3, 3) and finite, not {given.tolist()}")
    if not (base_m > 0.0 and post_m > 0.0):
        raise ValueError(f"base and post must be longer than 0: {base_m}, {post_m}")
    tip, left, right = given / np.linalg.norm(given, axis=1)[:, None]
    # q = 2 − 2 cos θ, which keeps its digits at small angles
    q12, q13, q23 = (float((a - b) @ (a - b)) for a, b in
                     ((tip, left), (tip, right), (left, right)))  # fmt: skip
    side2 = 0.25 * base_m * base_m + post_m * post_m
    if not q23 > 0.0:
        return Triangulation(np.full(3, np.nan), most, False, np.inf)
    middle = left + right
    cosine = float(middle @ tip / np.linalg.norm(middle))
    r, used = method((q12, q13, q23), base_m, post_m, cosine, most)
    errors = _equations(r, (q12, q13, q23), side2, base_m**2)
    residual = float(np.abs(errors).max()) / base_m**2
    if not (r.min() > 0.0 and math.isfinite(residual)):
        residual = math.inf
    return Triangulation(r, used, bool(used < most and residual < 1e-9), residual)


def _equations(r: Array, q: Squares, side2: float, base2: float) -> Array:
    """(3,) errors of the three laws of cosines, m²."""
    (r1, r2, r3), (q12, q13, q23) = r, q
    return np.array(
        [
            (r1 - r2) ** 2 + r1 * r2 * q12 - side2,
            (r1 - r3) ** 2 + r1 * r3 * q13 - side2,
            (r2 - r3) ** 2 + r2 * r3 * q23 - base2,
        ]
    )


def _newton(q: Squares, base: float, post: float, cosine: float, most: int) -> tuple[Array, int]:
    q12, q13, q23 = q
    half = math.sqrt(0.25 * q23)  # sin(θ23/2)
    outer = 0.5 * base / half
    middle = outer * math.sqrt(1.0 - half * half)
    sine2 = max(1.0 - cosine * cosine, 0.0)
    tip = middle * cosine - math.sqrt(max(post * post - middle * middle * sine2, 0.0))
    r, side2 = np.array([tip, outer, outer]), 0.25 * base * base + post * post
    for k in range(most):
        r1, r2, r3 = r
        slopes = np.array(
            [
                [2.0 * (r1 - r2) + r2 * q12, 2.0 * (r2 - r1) + r1 * q12, 0.0],
                [2.0 * (r1 - r3) + r3 * q13, 0.0, 2.0 * (r3 - r1) + r1 * q13],
                [0.0, 2.0 * (r2 - r3) + r3 * q23, 2.0 * (r3 - r2) + r2 * q23],
            ]
        )
        try:
            step = np.linalg.solve(slopes, _equations(r, q, side2, base * base))
        except np.linalg.LinAlgError:
            break
        r = r - step
        if np.abs(step).sum() < ROUNDING * np.abs(r).sum():
            return r, k + 1
    return r, most


def _alternate(q: Squares, base: float, post: float, cosine: float, most: int) -> tuple[Array, int]:
    swapped = q[0] < q[1]
    q12, q13, q23 = (q[1], q[0], q[2]) if swapped else q
    c12, c13, c23 = 1.0 - 0.5 * q12, 1.0 - 0.5 * q13, 1.0 - 0.5 * q23
    # sin² θ = q (1 − q/4)
    s12, s13, s23 = q12 * (1 - 0.25 * q12), q13 * (1 - 0.25 * q13), q23 * (1 - 0.25 * q23)
    half, side2 = math.sqrt(0.25 * q23), 0.25 * base * base + post * post
    r1, r2, r3 = 0.5 * base * math.sqrt(1.0 - half * half) / half, 0.0, 0.0
    used = most
    for k in range(most):
        r2 = r1 * c12 + math.sqrt(max(side2 - r1 * r1 * s12, 0.0))
        r3 = r2 * c23 + math.sqrt(max(base * base - r2 * r2 * s23, 0.0))
        last, r1 = r1, r3 * c13 - math.sqrt(max(side2 - r3 * r3 * s13, 0.0))
        if abs(r1 - last) < ROUNDING * abs(r1):
            used = k + 1
            break
    return np.array([r1, r3, r2] if swapped else [r1, r2, r3]), used
