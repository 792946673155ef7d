"""Motion at constant velocity: where a pose will be, and how uncertain it then is.

Rates (6,) are the angular rate (rotation vector, rad/s) and the velocity (m/s), both in the frame
that the pose leads to: ``R(t + dt) = exp(dt w) R(t)``, ``p(t + dt) = p(t) + dt v``. White
accelerations of a given spectral density disturb them. The covariance is of (rotation vector,
translation, angular rate, velocity), perturbation on the left (docs/conventions.md).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

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


def predict_covariance(covariance: Array, turn: Array, dt: float, density: Array) -> Array:
    """Covariance (12, 12) after ``dt``.

    Args:
        covariance: (12, 12) before.
        turn: (3, 3) rotation during ``dt``, with which the attitude error turns.
        density: (6,) spectral densities of the white accelerations, angular and linear.
    """
    step, i, j = np.eye(12), np.arange(6), np.arange(6, 12)
    step[:3, :3], step[i, j] = turn, dt
    out = step @ covariance @ step.T
    out[i, i] += density * dt**3 / 3.0
    out[i, j] += density * dt**2 / 2.0
    out[j, i] += density * dt**2 / 2.0
    out[j, j] += density * dt
    return np.asarray(out)
