"""Measurement models, compiled: residuals, Jacobians, covariances."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import (
    copy_into,
    copy_matrix_into,
    largest_at,
    square_root,
)
from rendezview.fusion.kernels import distance
from rendezview.geometry import so3
from rendezview.geometry.pose import Array

# Logarithm of a likelihood ratio at which one of two candidates is the one.
_DECIDED = 7.0  # Source: by construction, wrong once in 1100
# Of another edge than the ring's: σ of its bearing (rad), range (relative) and axis (rad); the same
# edge is taken again and again, so most of its error is bias.
_OTHER_BEARING, _OTHER_RANGE, _OTHER_RAD, _OTHER_BIAS_SHARE = 0.005, 0.1, 0.5, 0.9


@njit(cache=True, nogil=True, error_model="numpy")
def pose_model(
    measured_rotation: Array,
    measured_translation: Array,
    covariance: Array,
    rotation: Array,
    translation: Array,
    inflation: float,
    floor_rad: float,
    floor_range: float,
    share: float,
) -> tuple[Array, Array, Array]:
    """(6,) residual, (6, 6) white covariance and (6, 6) root of the bias's, of a pose."""
    residual = np.empty(6)
    turn = so3.between(measured_rotation, rotation)
    for i in range(3):
        residual[i] = turn[i]
        residual[3 + i] = measured_translation[i] - translation[i]
    whole = pose_covariance(measured_translation, covariance, inflation, floor_rad, floor_range)
    return residual, (1.0 - share) * whole, square_root(share * whole)


@njit(cache=True, nogil=True, error_model="numpy")
def pose_covariance(
    translation: Array, covariance: Array, inflation: float, floor_rad: float, floor_range: float
) -> Array:
    """(6, 6) covariance that the filter uses for a pose."""
    whole = inflation * covariance
    square = translation[0] ** 2 + translation[1] ** 2 + translation[2] ** 2
    for i in range(3):
        whole[i, i] += floor_rad**2
        whole[3 + i, 3 + i] += floor_range**2 * square
    return whole


@njit(cache=True, nogil=True, error_model="numpy")
def ring_model(
    ring_centre: Array,
    ring_axis: Array,
    rotation: Array,
    translation: Array,
    radius: float,
    depth: float,
) -> tuple[Array, Array, Array, Array]:
    """(3,) centre and (3,) axis expected, (3, 2) tangents of the axis, (5, 14) slope."""
    arm, axis = np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            arm[i] += rotation[i, j] * (ring_centre[j] + depth * ring_axis[j])
            axis[i] += rotation[i, j] * ring_axis[j]
    centre = (arm + translation) / radius
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
    slope = np.zeros((5, 14))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # w × arm: row i has w_j arm_k − w_k arm_j
        slope[i, j], slope[i, k] = arm[k] / radius, -arm[j] / radius
        slope[i, 3 + i] = 1.0 / radius
        slope[i, 12] = -centre[i] / radius
        slope[i, 13] = axis[i] / radius
    for c in range(2):
        for i in range(3):  # e · (w × n) = w · (n × e)
            j, k = (i + 1) % 3, (i + 2) % 3
            slope[3 + c, i] = axis[j] * basis[k, c] - axis[k] * basis[j, c]
    return centre, axis, basis, slope


@njit(cache=True, nogil=True, error_model="numpy")
def ring_residual(
    measured_centre: Array,
    measured_axis: Array,
    covariance: Array,
    centre: Array,
    axis: Array,
    basis: Array,
    inflation: float,
    floor_rad: float,
    floor_range: float,
    share: float,
) -> tuple[Array, Array, Array]:
    """(5,) residual, (5, 5) white covariance and (5, 10) root of the bias's, of a circle."""
    facing = 0.0
    for i in range(3):
        facing += measured_axis[i] * axis[i]
    sign = 1.0 if facing >= 0.0 else -1.0  # a circle has no front
    flat = np.zeros((5, 6))
    residual = np.zeros(5)
    for i in range(3):
        flat[i, i] = 1.0
        residual[i] = measured_centre[i] - centre[i]
        for c in range(2):
            flat[3 + c, 3 + i] = sign * basis[i, c]
            residual[3 + c] += sign * basis[i, c] * measured_axis[i]
    half = np.zeros((5, 6))
    whole = np.zeros((5, 5))
    for i in range(5):
        for j in range(6):
            for k in range(6):
                half[i, j] += flat[i, k] * covariance[k, j]
    for i in range(5):
        for j in range(5):
            for k in range(6):
                whole[i, j] += half[i, k] * flat[j, k]
            whole[i, j] *= inflation
    square = measured_centre[0] ** 2 + measured_centre[1] ** 2 + measured_centre[2] ** 2
    for i in range(3):
        whole[i, i] += floor_range**2 * square
    for i in range(3, 5):
        whole[i, i] += floor_rad**2
    both = np.zeros((5, 10))
    copy_matrix_into(square_root(share * whole), both)
    return residual, (1.0 - share) * whole, both


@njit(cache=True, nogil=True, error_model="numpy")
def other_edge(place: Array) -> tuple[Array, Array]:
    """(5, 5) white covariance and (5, 10) root of the bias's, of an edge near the ring's.

    ``place`` (3,) is where it would be if it were the ring's.
    """
    square = place[0] ** 2 + place[1] ** 2 + place[2] ** 2
    whole = np.zeros((5, 5))
    for i in range(3):
        whole[i, i] = _OTHER_BEARING**2 * square
        for j in range(3):
            whole[i, j] += _OTHER_RANGE**2 * place[i] * place[j]
    whole[3, 3] = whole[4, 4] = _OTHER_RAD**2
    both = np.zeros((5, 10))
    copy_matrix_into(square_root(_OTHER_BIAS_SHARE * whole), both[:, 5:])
    return (1.0 - _OTHER_BIAS_SHARE) * whole, both


@njit(cache=True, nogil=True, error_model="numpy")
def mixture(
    logs: Array, best: int, residuals: Array, whites: Array, roots: Array
) -> tuple[Array, Array, Array]:
    """Mean residual (5,), white covariance (5, 5) and bias root (5, 10) of K candidates.

    Weighted by likelihood, ``logs`` (K,); the spread of the residuals is added. Candidates that are
    much less likely than the ``best`` are left out.
    """
    count = len(logs)
    total = 0.0
    residual = np.zeros(5)
    white, root = np.zeros((5, 5)), np.zeros((5, 10))
    for k in range(count):
        if k == best or logs[k] > logs[best] - _DECIDED:
            total += np.exp(logs[k] - logs[best]) if k != best else 1.0
    for k in range(count):
        if k != best and not logs[k] > logs[best] - _DECIDED:
            continue
        share = (np.exp(logs[k] - logs[best]) if k != best else 1.0) / total
        for i in range(5):
            residual[i] += share * residuals[k, i]
            for j in range(5):
                white[i, j] += share * (whites[k, i, j] + residuals[k, i] * residuals[k, j])
            for j in range(10):
                root[i, j] += share * roots[k, i, j]
    for i in range(5):
        for j in range(5):
            white[i, j] -= residual[i] * residual[j]
    return residual, white, root


@njit(cache=True, nogil=True, error_model="numpy")
def ring_expected(
    centres: Array,
    axes: Array,
    covariances: Array,
    ring_centre: Array,
    ring_axis: Array,
    rotation: Array,
    translation: Array,
    extras: Array,
    covariance: Array,
    start: int,
    inflation: float,
    floor_rad: float,
    floor_range: float,
    share: float,
    chance_of_other: float,
) -> tuple[bool, bool, Array, Array, Array, Array]:
    """Candidates (K, 3), (K, 3), (K, 6, 6) of a ring, and another edge, as one measurement.

    It is their mean and spread by how likely each is. Where they are far apart one has all the
    weight; a ring seen face-on does not show on which side of the line of sight its axis is.

    Returns:
        Whether the ring is before the camera; whether the likeliest is another edge; (5,)
        residual, (5, 14) slope, (5, 5) white covariance, (5, 10) root of the bias's.
    """
    # The radius that the sensor takes is too small by this factor: so is its centre's distance.
    centre, axis, basis, slope = ring_model(
        ring_centre, ring_axis, rotation, translation, 1.0 + extras[0], extras[1]
    )
    known = len(centres)
    count = known + 1 if chance_of_other > 0.0 else known
    residuals, logs = np.zeros((count, 5)), np.zeros(count)
    whites, roots = np.zeros((count, 5, 5)), np.zeros((count, 5, 10))
    for k in range(known):
        residual, white, root = ring_residual(
            centres[k], axes[k], covariances[k], centre, axis, basis,
            inflation, floor_rad, floor_range, share,
        )  # fmt: skip
        copy_into(residual, residuals[k])
        copy_matrix_into(white, whites[k])
        copy_matrix_into(root, roots[k])
        logs[k] = np.log((1.0 - chance_of_other) / known)
    if count > known:
        # A concentric edge, or one of a shadow: the line of sight is nearly right, the size not.
        copy_into(residuals[0], residuals[known])
        white, root = other_edge(centres[0])
        copy_matrix_into(white, whites[known])
        copy_matrix_into(root, roots[known])
        logs[known] = np.log(chance_of_other)
    best = 0
    if count > 1:
        for k in range(count):
            _, nis, log_volume = distance(
                extras, covariance, slope, roots[k], start, whites[k], residuals[k]
            )
            logs[k] -= 0.5 * (nis + log_volume)  # −∞ where it cannot be used
        best = largest_at(logs)
    residual, white, root = mixture(logs, best, residuals, whites, roots)
    return centre[2] > 0.0, best == known, residual, slope, white, root
