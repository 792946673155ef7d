"""Motion at constant velocity: where a pose will be, and how uncertain it then is.

Rates (6,) are the angular rate (rotation vector, rad/s) and the velocity (m/s), both in the frame
that the pose leads to: ``R(t + dt) = exp(dt w) R(t)``, ``p(t + dt) = p(t) + dt v``. White
accelerations of a given spectral density disturb them. The covariance is of (rotation vector,
translation, angular rate, velocity), perturbation on the left (docs/conventions.md).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose


def extrapolate(pose: Pose, rates: Array, dt_s: float, about_m: npt.ArrayLike = (0, 0, 0)) -> Pose:
    """The pose ``dt_s`` later.

    Args:
        rates: (6,) angular rate, and velocity of the point ``about_m``.
        about_m: (3,) target frame; the rotation leaves this point where the velocity puts it.
    """
    point_m = np.asarray(about_m, np.float64)
    rotation = np.empty((3, 3))
    # The copy can be written to: for read-only arrays numba compiles another function.
    so3.perturb_into(dt_s * rates[:3], pose.rotation.copy(), rotation)
    return Pose(rotation, pose.apply(point_m) + dt_s * rates[3:] - rotation @ point_m)


def rates_between(
    before: Pose, after: Pose, dt_s: float, about_m: npt.ArrayLike = (0, 0, 0)
) -> Array:
    """(6,) rates that lead from one pose to another: the inverse of `extrapolate`."""
    moved_m = after.apply(about_m) - before.apply(about_m)
    return np.concatenate([so3.between(after.rotation, before.rotation), moved_m]) / dt_s


@njit(cache=True, nogil=True, error_model="numpy")
def predict_covariance(
    covariance: Array, turn: Array, dt: float, density: Array, fade: Array
) -> Array:
    """Covariance (n, n) after ``dt``: 12 states of motion, then states that only fade.

    Args:
        covariance: (n, n) before.
        turn: (3, 3) rotation during ``dt``, with which the attitude error turns.
        density: (6, 6) spectral density of the white accelerations, angular and linear.
        fade: (n - 12,) factor of each further state, towards a variance of 1; 1 for a constant.
    """
    n = len(covariance)
    out = covariance.copy()
    for j in range(n):  # rows: F P
        a, b, c = out[0, j], out[1, j], out[2, j]
        for i in range(3):
            out[i, j] = turn[i, 0] * a + turn[i, 1] * b + turn[i, 2] * c + dt * out[6 + i, j]
            out[3 + i, j] += dt * out[9 + i, j]
    for i in range(12, n):
        for j in range(n):
            out[i, j] *= fade[i - 12]
    for i in range(n):  # columns: (F P) Fᵀ
        a, b, c = out[i, 0], out[i, 1], out[i, 2]
        for j in range(3):
            out[i, j] = turn[j, 0] * a + turn[j, 1] * b + turn[j, 2] * c + dt * out[i, 6 + j]
            out[i, 3 + j] += dt * out[i, 9 + j]
        for j in range(12, n):
            out[i, j] *= fade[j - 12]
    for i in range(12, n):
        out[i, i] += 1.0 - fade[i - 12] ** 2
    for i in range(6):
        for j in range(6):
            q = density[i, j]
            if q != 0.0:
                out[i, j] += q * dt * dt * dt / 3.0
                out[i, 6 + j] += q * dt * dt / 2.0
                out[6 + i, j] += q * dt * dt / 2.0
                out[6 + i, 6 + j] += q * dt
    return out
