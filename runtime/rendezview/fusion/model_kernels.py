"""The loops of the measurement models, compiled: expected values, slopes and covariances."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.geometry import so3
from rendezview.geometry.pose import Array


@njit(cache=True, nogil=True, error_model="numpy")
def pose_parts(
    measured_rotation: Array, measured_translation: Array, rotation: Array, place: Array
) -> tuple[Array, Array]:
    """(6,) residual of a pose, and its (6, 6) slope by attitude and place."""
    away, residual, motion = np.empty(3), np.empty(6), np.zeros((6, 6))
    so3.rotate_into(rotation, -place, away)
    turn = so3.between(measured_rotation, rotation)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        residual[i], residual[3 + i] = turn[i], measured_translation[i] - away[i]
        motion[i, i] = 1.0
        motion[3 + i, j], motion[3 + i, k] = away[k], -away[j]  # θ × away
        for c in range(3):
            motion[3 + i, 3 + c] = -rotation[i, c]
    return residual, motion


@njit(cache=True, nogil=True, error_model="numpy")
def ring_parts(
    ring_centre: Array, ring_axis: Array, rotation: Array, place: Array, radius: float,
    depth_m: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Expected centre (3,) and axis (3,) of a ring; tangents (3, 2); slope (5, 8).

    Args:
        radius: true one over the given one. The radius that the sensor takes is too small by this
            factor: so is its centre's distance.
        depth_m: offset along the axis.

    Returns:
        The slope is by attitude, place, radius and depth.
    """
    away, centre, axis = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        away[i] = (ring_centre[i] + depth_m * ring_axis[i] - place[i]) / radius
    so3.rotate_into(rotation, away, centre)
    so3.rotate_into(rotation, ring_axis, axis)
    basis = np.zeros((3, 2))
    across = 1 if abs(axis[0]) > 1.0 - 1e-6 else 0
    basis[across, 0] = 1.0
    for i in range(3):
        basis[i, 0] -= axis[across] * axis[i]
    length = np.sqrt(basis[0, 0] ** 2 + basis[1, 0] ** 2 + basis[2, 0] ** 2)
    for i in range(3):
        basis[i, 0] /= length
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        basis[i, 1] = axis[j] * basis[k, 0] - axis[k] * basis[j, 0]
    motion = np.zeros((5, 8))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        motion[i, j], motion[i, k] = centre[k], -centre[j]  # θ × centre
        motion[i, 6] = -centre[i] / radius
        motion[i, 7] = axis[i] / radius
        for c in range(3):
            motion[i, 3 + c] = -rotation[i, c] / radius
        for c in range(2):  # e · (θ × n) = θ · (n × e)
            motion[3 + c, i] = axis[j] * basis[k, c] - axis[k] * basis[j, c]
    return centre, axis, basis, motion


@njit(cache=True, nogil=True, error_model="numpy")
def circle_parts(
    measured_centre: Array, measured_axis: Array, covariance: Array, centre: Array, axis: Array,
    basis: Array, inflation: float,
) -> tuple[Array, Array]:  # fmt: skip
    """(5,) residual and (5, 5) covariance of a circle beside the expected one.

    Args:
        covariance: (6, 6) of centre and axis.
        inflation: of the covariance.
    """
    facing = 0.0
    for i in range(3):
        facing += measured_axis[i] * axis[i]
    sign = 1.0 if facing >= 0.0 else -1.0  # a circle has no front
    flat, residual = np.zeros((5, 6)), np.zeros(5)
    for i in range(3):
        flat[i, i] = 1.0
        residual[i] = measured_centre[i] - centre[i]
        for c in range(2):
            flat[3 + c, 3 + i] = sign * basis[i, c]
            residual[3 + c] += sign * basis[i, c] * measured_axis[i]
    half, whole = np.zeros((5, 6)), np.zeros((5, 5))
    for i in range(5):
        for j in range(6):
            for k in range(6):
                half[i, j] += flat[i, k] * covariance[k, j]
    for i in range(5):
        for j in range(5):
            for k in range(6):
                whole[i, j] += half[i, k] * flat[j, k]
            whole[i, j] *= inflation
    return residual, whole


@njit(cache=True, nogil=True, error_model="numpy")
def of_other_edge(
    whole: Array, place: Array, bearing: float, range_share: float, tilt: float
) -> Array:
    """(5, 5) covariance of a circle that is another edge than the ring's, seen at (3,) place.

    A concentric edge, or one of a shadow: the line of sight is nearly right, the size not.

    Args:
        bearing, tilt: σ that it adds, rad.
        range_share: σ that it adds to the range, over the range.
    """
    wide = whole.copy()
    square = place[0] ** 2 + place[1] ** 2 + place[2] ** 2
    for i in range(3):
        wide[i, i] += bearing**2 * square
        for j in range(3):
            wide[i, j] += range_share**2 * place[i] * place[j]
    wide[3, 3] += tilt**2
    wide[4, 4] += tilt**2
    return wide
