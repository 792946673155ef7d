"""The robust cost of a segment, its slopes and its normal equations: compiled.

The cost of parameters p is Σ w_i q_i / (1 + q_i / c²) (Geman and McClure), with q_i the squared
misfit of point i in its own standard deviations: near ones count as in least squares, one far off
costs c² at most, however far it is.

A refined pose's misfit is its distance in the metric of its covariance. An active node's is that of
its *direction* and that of its *range*, apart: nodes lie scattered on a sphere about the target,
and the mean of points on a sphere lies below its surface, 1 % at 8°.

``data`` is (times, base, constants, carrier, points, whitening, by_node): see ``shapes.places`` and
``residuals``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.trajectory.shapes import places

Data = tuple[Any, ...]  # times, base, constants, carrier, points, whitening, by_node

# Source: by construction
RESIDUALS = 4  # of a point: three of its place or direction, one of its range


@njit(cache=True, nogil=True, error_model="numpy")
def residuals(code: int, p: Array, data: Data, place: Array, out: Array) -> None:
    """Fill (N, 4): misfits of all points in standard deviations.

    Of ``data``: ``carrier`` (N, 3) are places that those of the shape are added to: a plan, or
    zeros. ``points`` (N, 3) are places of poses, unit directions of nodes. ``whitening`` (N, 3, 3)
    is the square root of a pose's information; of nodes [0, 0] is 1/σ of the direction, [1, 1] 1/σ
    of the range, [2, 2] the range. ``place`` (N, 3) is scratch.
    """
    times, base, constants, carrier, points, whitening, by_node = data
    places(code, p, times, base, constants, place)
    for k in range(len(times)):
        x = place[k, 0] + carrier[k, 0]
        y = place[k, 1] + carrier[k, 1]
        z = place[k, 2] + carrier[k, 2]
        w = whitening[k]
        if by_node[k]:
            far = np.sqrt(x * x + y * y + z * z) + 1e-12
            out[k, 0] = w[0, 0] * (x / far - points[k, 0])
            out[k, 1] = w[0, 0] * (y / far - points[k, 1])
            out[k, 2] = w[0, 0] * (z / far - points[k, 2])
            out[k, 3] = w[1, 1] * (far - w[2, 2])
        else:
            x, y, z = x - points[k, 0], y - points[k, 1], z - points[k, 2]
            for i in range(3):
                out[k, i] = w[i, 0] * x + w[i, 1] * y + w[i, 2] * z
            out[k, 3] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def cost(
    code: int, p: Array, data: Data, weights: Array, cut: float, place: Array, out: Array
) -> float:
    """The robust cost; ``cut`` is c², infinite for plain least squares."""
    residuals(code, p, data, place, out)
    total = 0.0
    for k in range(len(weights)):
        q = out[k, 0] ** 2 + out[k, 1] ** 2 + out[k, 2] ** 2 + out[k, 3] ** 2
        total += weights[k] * q / (1.0 + q / cut)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def jacobian(code: int, p: Array, scales: Array, data: Data, place: Array, out: Array) -> Array:
    """(N, 4, P) of the residuals, by central differences of 1e-4 of ``scales`` (P,)."""
    slopes = np.empty((len(out), RESIDUALS, len(p)))
    moved = p.copy()
    for j in range(len(p)):
        step = 1e-4 * scales[j]
        moved[j] = p[j] + step
        residuals(code, moved, data, place, out)
        for k in range(len(out)):
            for i in range(RESIDUALS):
                slopes[k, i, j] = out[k, i]
        moved[j] = p[j] - step
        residuals(code, moved, data, place, out)
        for k in range(len(out)):
            for i in range(RESIDUALS):
                slopes[k, i, j] = (slopes[k, i, j] - out[k, i]) / (2.0 * step)
        moved[j] = p[j]
    return slopes


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    code: int, p: Array, scales: Array, data: Data, weights: Array, cut: float
) -> tuple[Array, Array]:
    """Matrix (P, P) and right side (P,) of one Gauss–Newton step of the robust cost."""
    size = len(p)
    place = np.empty((len(weights), 3))
    out = np.empty((len(weights), RESIDUALS))
    slopes = jacobian(code, p, scales, data, place, out)
    residuals(code, p, data, place, out)
    matrix, right = np.zeros((size, size)), np.zeros(size)
    for k in range(len(weights)):
        q = out[k, 0] ** 2 + out[k, 1] ** 2 + out[k, 2] ** 2 + out[k, 3] ** 2
        weight = weights[k] / (1.0 + q / cut) ** 2
        for i in range(RESIDUALS):
            for a in range(size):
                lever = weight * slopes[k, i, a]
                right[a] -= lever * out[k, i]
                for b in range(a, size):
                    matrix[a, b] += lever * slopes[k, i, b]
    for a in range(size):
        for b in range(a):
            matrix[a, b] = matrix[b, a]
    return matrix, right
