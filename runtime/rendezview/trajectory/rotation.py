"""Free rotation of a rigid body, compiled: Euler's equations and the attitude together.

    I ω' = −ω × I ω        R' = R [ω]×

with ω in principal axes and R ``reference_from_body``. Equal moments keep ω: constant spin is
the same code.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into
from rendezview.geometry import so3
from rendezview.geometry.pose import Array

# Of turn, at most, between two evaluations: an error below 1e-7 rad a turn. Source: by
# construction, the order of the method
_STEP_RAD = 0.1


@njit(cache=True, nogil=True, error_model="numpy")
def _advance(
    moments: Array, rotation: Array, rate: Array, span: float, vector: Array, turned: Array
) -> None:
    """Turn ``rotation`` (3, 3) and ``rate`` (3,), body axes, on by ``span`` seconds, in place.

    The rate by Runge and Kutta's fourth order; the attitude by Magnus' expansion of the same
    order, so that it stays a rotation: Ω = ∫ω (Simpson) + h²/12 (ω_first × ω_last).
    """
    a = (moments[1] - moments[2]) / moments[0]
    b = (moments[2] - moments[0]) / moments[1]
    c = (moments[0] - moments[1]) / moments[2]
    p, q, r = rate[0], rate[1], rate[2]
    size = math.sqrt(p * p + q * q + r * r)
    steps = max(1, int(np.ceil(abs(size * span) / _STEP_RAD)))
    h = span / steps
    for _ in range(steps):
        p1, q1, r1 = a * q * r, b * r * p, c * p * q
        x, y, z = p + 0.5 * h * p1, q + 0.5 * h * q1, r + 0.5 * h * r1
        p2, q2, r2 = a * y * z, b * z * x, c * x * y
        x, y, z = p + 0.5 * h * p2, q + 0.5 * h * q2, r + 0.5 * h * r2
        p3, q3, r3 = a * y * z, b * z * x, c * x * y
        x, y, z = p + h * p3, q + h * q3, r + h * r3
        p4, q4, r4 = a * y * z, b * z * x, c * x * y
        x = p + h / 6.0 * (p1 + 2.0 * p2 + 2.0 * p3 + p4)
        y = q + h / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)
        z = r + h / 6.0 * (r1 + 2.0 * r2 + 2.0 * r3 + r4)
        # Simpson, its middle by cubic Hermite from the rates and slopes at both ends.
        f = h * h / 12.0
        vector[0] = 0.5 * h * (p + x) + f * (p1 - a * y * z) + f * (q * z - r * y)
        vector[1] = 0.5 * h * (q + y) + f * (q1 - b * z * x) + f * (r * x - p * z)
        vector[2] = 0.5 * h * (r + z) + f * (r1 - c * x * y) + f * (p * y - q * x)
        so3.exp_into(vector, turned)
        for i in range(3):
            u, v, w = rotation[i, 0], rotation[i, 1], rotation[i, 2]
            for j in range(3):
                rotation[i, j] = u * turned[0, j] + v * turned[1, j] + w * turned[2, j]
        p, q, r = x, y, z
    rate[0], rate[1], rate[2] = p, q, r


@njit(cache=True, nogil=True, error_model="numpy")
def rotations(
    moments: Array, first: Array, first_rate: Array, times: Array, out: Array, rates: Array
) -> None:
    """Fill attitudes (N, 3, 3) and rates (N, 3), body axes, at times (N,) that never fall.

    Args:
        moments: (3,) moments about the body's axes, its principal ones; any unit.
        first, first_rate: attitude and rate at time 0, which may lie anywhere among ``times``.
    """
    count = len(times)
    vector, turned = np.empty(3), np.empty((3, 3))
    start = 0
    while start < count and times[start] < 0.0:
        start += 1
    for way in range(2):
        rotation, rate, now = first.copy(), first_rate.copy(), 0.0
        for step in range(count - start if way == 0 else start):
            k = start + step if way == 0 else start - 1 - step
            if times[k] != now:
                _advance(moments, rotation, rate, times[k] - now, vector, turned)
                now = times[k]
            copy_matrix_into(rotation, out[k])
            copy_into(rate, rates[k])
