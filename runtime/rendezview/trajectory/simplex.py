"""The downhill simplex and its check: two compiled ways down one robust cost.

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

from rendezview.estimation.least_squares import (
    DAMPING_DECAY,
    DAMPING_GROWTH,
    FIRST_DAMPING,
    ROUNDING,
    damped_step,
)
from rendezview.estimation.linear_algebra import copy_into, descending
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
def downhill_simplex(
    code: int, start: Array, steps: Array, data: Data, weights: Array, cut: float, most: int,
    near: float,
) -> tuple[Array, float, int]:  # fmt: skip
    """Nelder and Mead's simplex, with Gao and Han's (2012) coefficients for P dimensions.

    Args:
        start: (P,) first corner; the others lie ``steps`` (P,) away along the axes.
        most: evaluations, at most.
        near: ends when no corner costs more than so much above the best.

    Returns:
        (P,) the best corner, its cost, and how often the cost was asked for.
    """
    size = len(start)
    place, out = np.empty((len(weights), 3)), np.empty((len(weights), RESIDUALS))
    corners, costs = np.empty((size + 1, size)), np.empty(size + 1)
    spare, sunk = np.empty((size + 1, size)), np.empty(size + 1)
    for k in range(size + 1):
        copy_into(start, corners[k])
    for k in range(size):
        corners[k + 1, k] += steps[k]
    _fill_costs(code, corners, data, weights, cut, place, out, costs, 0)
    asked = size + 1
    expand, contract, shrink = 1.0 + 2.0 / size, 0.75 - 0.5 / size, 1.0 - 1.0 / size
    trial, second, away = np.empty(size), np.empty(size), np.empty(size)
    while asked < most:
        _sort(corners, costs, spare, sunk)
        corners, spare, costs, sunk = spare, corners, sunk, costs
        if costs[size] - costs[0] <= near:
            break
        middle = _mean(corners[:size])
        _ahead(middle, -1.0, corners[size], away)
        _ahead(middle, 1.0, away, trial)
        at_trial = cost(code, trial, data, weights, cut, place, out)
        asked += 1
        if costs[0] <= at_trial < costs[size - 1]:
            copy_into(trial, corners[size])
            costs[size] = at_trial
            continue
        inwards = contract if at_trial < costs[size] else -contract
        _ahead(middle, expand if at_trial < costs[0] else inwards, away, second)
        at_second = cost(code, second, data, weights, cut, place, out)
        asked += 1
        if at_second < min(at_trial, costs[size]):
            copy_into(second, corners[size])
            costs[size] = at_second
        elif at_trial < costs[0]:
            copy_into(trial, corners[size])
            costs[size] = at_trial
        else:
            for k in range(1, size + 1):
                _ahead(corners[k], -1.0, corners[0], away)
                _ahead(corners[0], shrink, away, corners[k])
            _fill_costs(code, corners, data, weights, cut, place, out, costs, 1)
            asked += size
    _sort(corners, costs, spare, sunk)
    return spare[0], sunk[0], asked


@njit(cache=True, nogil=True, error_model="numpy")
def _mean(corners: Array) -> Array:
    """(P,) the mean of points (N, P)."""
    middle = np.zeros(corners.shape[1])
    for k in range(len(corners)):
        for i in range(len(middle)):
            middle[i] += corners[k, i] / len(corners)
    return middle


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(corners: Array, costs: Array, spare: Array, sunk: Array) -> None:
    """Fill ``spare`` (N, P) and ``sunk`` (N,) with corners and costs, the least cost first."""
    for k in range(len(costs)):
        sunk[k] = -costs[k]
    order = descending(sunk)
    for k in range(len(costs)):
        sunk[k] = costs[order[k]]
        copy_into(corners[order[k]], spare[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _ahead(middle: Array, share: float, away: Array, out: Array) -> None:
    """Fill ``out`` (P,), some shares of a way (P,) from a point (P,)."""
    for i in range(len(middle)):
        out[i] = middle[i] + share * away[i]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _fill_costs(
    code: int, corners: Array, data: Data, weights: Array, cut: float, place: Array, out: Array,
    costs: Array, first: int,
) -> None:  # fmt: skip
    """The costs of the simplex's corners from number ``first`` on."""
    for k in range(first, len(costs)):
        costs[k] = cost(code, corners[k], data, weights, cut, place, out)


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


@njit(cache=True, nogil=True, error_model="numpy")
def gauss_newton(
    code: int, start: Array, scales: Array, data: Data, weights: Array, cut: float, most: int
) -> tuple[Array, float]:
    """Gauss–Newton with Levenberg's damping down the same cost: the simplex's start and check.

    Returns:
        (P,) parameters, their cost.
    """
    size = len(start)
    p = start.copy()
    place = np.empty((len(weights), 3))
    out = np.empty((len(weights), RESIDUALS))
    step, lower = np.empty(size), np.empty((size, size))
    here = cost(code, p, data, weights, cut, place, out)
    damping = 1e-6
    for _ in range(most):
        matrix, right = normal_equations(code, p, scales, data, weights, cut)
        for a in range(size):  # what nothing is known of stays where it is
            matrix[a, a] += 1e-12 / scales[a] ** 2
        better = False
        there = here
        for _ in range(6):
            if damped_step(matrix, right, damping, lower, step):
                there = cost(code, p + step, data, weights, cut, place, out)
                if there <= here * (1.0 + ROUNDING):
                    better = True
                    break
            damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        if not better:
            break
        gain = here - there
        p, here = p + step, there
        damping *= DAMPING_DECAY
        if gain <= 1e-4:  # of χ²: a hundredth of a σ
            break
    return p, here
