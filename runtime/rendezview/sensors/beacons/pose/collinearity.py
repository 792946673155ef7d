"""The collinearity equations of all lights in all cameras, linearised and solved.

Welch et al., eq. 3 and 4 with Newton's approximation: two equations for each light in each
camera (24 for six lights and two cameras), six unknowns. The attitude is a rotation matrix
with a small left rotation vector as its unknown, so that no attitude is singular; yaw,
pitch and roll appear in `rendezview.sensors.beacons.euler` only.

Frames: everything in the rig frame, ``p_rig = R p_target + t``. Arrays named alike in all
functions: ``leds`` (L, 3) target frame; ``cr`` (C, 3, 3), ``ct`` (C, 3) camera from rig;
``xy``, ``weight`` (C, L, 2) as in `rendezview.sensors.beacons.rig.Sights`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation import linear_algebra
from rendezview.geometry import so3

Array = npt.NDArray[np.float64]

_NEAREST = 1e-9  # metres in front of a camera. Source: by construction, no division by 0


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp"}, forceinline=True)
def normal_equations(
    rotation: Array,
    translation: Array,
    leds: Array,
    cr: Array,
    ct: Array,
    xy: Array,
    weight: Array,
    information: Array,
    gradient: Array,
) -> float:
    """Fill JᵀJ (6, 6) and Jᵀr (6,) of the weighted equations; returns the sum of squares.

    Residual: observed less predicted, over σ. Infinite where a light is behind a camera.
    """
    # The sums are kept in scalars: in arrays they cost more than the equations.
    cost = 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    n00 = n10 = n11 = n20 = n21 = n22 = n30 = n31 = n32 = n33 = 0.0
    n40 = n41 = n42 = n43 = n44 = n50 = n51 = n52 = n53 = n54 = n55 = 0.0
    for j in range(leds.shape[0]):
        a, b, c = leds[j, 0], leds[j, 1], leds[j, 2]
        ax = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
        ay = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
        az = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
        px, py, pz = ax + translation[0], ay + translation[1], az + translation[2]
        for k in range(cr.shape[0]):
            if weight[k, j, 0] == 0.0:
                continue
            m20, m21, m22 = cr[k, 2, 0], cr[k, 2, 1], cr[k, 2, 2]
            z = m20 * px + m21 * py + m22 * pz + ct[k, 2]
            if not z > _NEAREST:
                return np.inf
            inverse = 1.0 / z
            for i in range(2):
                m0, m1, m2 = cr[k, i, 0], cr[k, i, 1], cr[k, i, 2]
                x = (m0 * px + m1 * py + m2 * pz + ct[k, i]) * inverse  # eq. 4
                r = weight[k, j, i] * (xy[k, j, i] - x)
                w = weight[k, j, i] * inverse
                gx, gy, gz = w * (m0 - x * m20), w * (m1 - x * m21), w * (m2 - x * m22)
                # d p / d(rotation vector) = −[R p]×, so the row is (R p) × g
                h0, h1, h2 = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
                cost += r * r
                b0, b1, b2 = b0 + h0 * r, b1 + h1 * r, b2 + h2 * r
                b3, b4, b5 = b3 + gx * r, b4 + gy * r, b5 + gz * r
                n00, n10, n20 = n00 + h0 * h0, n10 + h1 * h0, n20 + h2 * h0
                n30, n40, n50 = n30 + gx * h0, n40 + gy * h0, n50 + gz * h0
                n11, n21, n31 = n11 + h1 * h1, n21 + h2 * h1, n31 + gx * h1
                n41, n51, n22 = n41 + gy * h1, n51 + gz * h1, n22 + h2 * h2
                n32, n42, n52 = n32 + gx * h2, n42 + gy * h2, n52 + gz * h2
                n33, n43, n53 = n33 + gx * gx, n43 + gy * gx, n53 + gz * gx
                n44, n54, n55 = n44 + gy * gy, n54 + gz * gy, n55 + gz * gz
    _fill(
        (b0, b1, b2, b3, b4, b5), gradient,
        (n00, n10, n11, n20, n21, n22, n30, n31, n32, n33, n40, n41, n42, n43, n44,
         n50, n51, n52, n53, n54, n55), information,
    )  # fmt: skip
    return cost


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _fill(
    right: tuple[float, float, float, float, float, float], gradient: Array,
    lower: tuple[float, ...], information: Array,
) -> None:  # fmt: skip
    """Put the sums into their arrays; ``lower`` is the triangle, row by row."""
    for i in range(6):
        gradient[i] = right[i]
        for j in range(i + 1):
            information[i, j] = information[j, i] = lower[i * (i + 1) // 2 + j]


@njit(cache=True, nogil=True, error_model="numpy")
def squares(
    rotation: Array,
    translation: Array,
    leds: Array,
    normals: Array,
    cr: Array,
    ct: Array,
    xy: Array,
    weight: Array,
    out: Array,
) -> None:
    """Fill (C, L) sums of squared weighted residuals of each light in each camera.

    0 where not visible; infinite where the light would be behind the camera or shine away from
    it (``normals`` (L, 3), zeros where its beam is not known).
    """
    p, n, q, m = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for j in range(leds.shape[0]):
        so3.rotate_into(rotation, leds[j], p)
        so3.rotate_into(rotation, normals[j], n)
        for i in range(3):
            p[i] += translation[i]
        for k in range(cr.shape[0]):
            out[k, j] = 0.0
            if weight[k, j, 0] == 0.0:
                continue
            so3.rotate_into(cr[k], p, q)
            so3.rotate_into(cr[k], n, m)
            for i in range(3):
                q[i] += ct[k, i]
            if not q[2] > _NEAREST or m[0] * q[0] + m[1] * q[1] + m[2] * q[2] > 0.0:
                out[k, j] = np.inf
                continue
            rx = weight[k, j, 0] * (xy[k, j, 0] - q[0] / q[2])
            ry = weight[k, j, 1] * (xy[k, j, 1] - q[1] / q[2])
            out[k, j] = rx * rx + ry * ry


@njit(cache=True, nogil=True, error_model="numpy")
def count_lights(weight: Array) -> tuple[int, int]:
    """How many lights any camera sees, and how many equations they give."""
    lights, equations = 0, 0
    for j in range(weight.shape[1]):
        visible = False
        for k in range(weight.shape[0]):
            if weight[k, j, 0] > 0.0:
                visible = True
                equations += 2
        lights += visible
    return lights, equations


@njit(cache=True, nogil=True, error_model="numpy")
def solve(
    rotation: Array, translation: Array, leds: Array, cr: Array, ct: Array, xy: Array,
    weight: Array, prior: Array, prior_rotation: Array, prior_translation: Array, iterations: int,
    tolerance: float, information: Array,
) -> tuple[float, int, bool]:  # fmt: skip
    """Newton-linearised least squares from (rotation, translation), which become the answer.

    Plain steps as in the paper; one that makes the sum of squares larger is shortened by
    Levenberg's and Marquardt's damping.

    Args:
        prior: (6, 6) information about the pose besides the equations, zeros for none,
            around (prior_rotation, prior_translation).
        iterations: at most so many steps are taken; 1 is the paper's single iteration.
        tolerance: of the step's length in standard deviations, where it ends.
        information: (6, 6) becomes that at the answer, prior included.

    Returns:
        sum of squares, steps taken, and whether it ended within the tolerance.
    """
    gradient, step, trial_gradient = np.empty(6), np.empty(6), np.empty(6)
    damped, lower, trial_information = np.empty((6, 6)), np.zeros((6, 6)), np.empty((6, 6))
    trial_r, trial_t = np.empty((3, 3)), np.empty(3)
    cost = _cost_at(
        rotation, translation, leds, cr, ct, xy, weight, prior, prior_rotation, prior_translation,
        information, gradient,
    )  # fmt: skip
    if not cost < np.inf:
        return np.inf, 0, False
    damping = 0.0
    for taken in range(1, iterations + 1):
        while True:
            _damp(information, damping, damped)
            if not linear_algebra.solve(damped, gradient, lower, step):
                if damping > 1e9 or not information[0, 0] > 0.0:
                    return cost, taken, False
                damping = max(10.0 * damping, 1e-6)
                continue
            length = _try_step(step, gradient, rotation, translation, trial_r, trial_t)
            if not length < 1e30:
                return cost, taken, False
            if length < tolerance * tolerance and damping < 1e-2:
                _move(trial_r, trial_t, rotation, translation)
                return cost - length, taken, True  # so short a step is as good as linear
            trial = _cost_at(
                trial_r, trial_t, leds, cr, ct, xy, weight, prior, prior_rotation,
                prior_translation, trial_information, trial_gradient,
            )  # fmt: skip
            if trial <= cost * (1.0 + 1e-12) + 1e-12 or (iterations == 1 and trial < np.inf):
                break
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e9:
                return cost, taken, False
        _move(trial_r, trial_t, rotation, translation)
        _move(trial_information, trial_gradient, information, gradient)
        cost = trial
        damping = 0.1 * damping if damping > 1e-6 else 0.0
    return cost, iterations, False


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _move(matrix: Array, vector: Array, to_matrix: Array, to_vector: Array) -> None:
    linear_algebra.copy_matrix_into(matrix, to_matrix)
    linear_algebra.copy_into(vector, to_vector)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cost_at(
    rotation: Array, translation: Array, leds: Array, cr: Array, ct: Array, xy: Array,
    weight: Array, prior: Array, prior_rotation: Array, prior_translation: Array,
    information: Array, gradient: Array,
) -> float:  # fmt: skip
    """`normal_equations` with the prior added, if there is one."""
    cost = normal_equations(
        rotation, translation, leds, cr, ct, xy, weight, information, gradient
    )  # fmt: skip
    if prior[0, 0] > 0.0 and cost < np.inf:
        cost += _add_prior(
            rotation, translation, prior, prior_rotation, prior_translation, information, gradient
        )
    return cost


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _damp(information: Array, damping: float, damped: Array) -> None:
    for i in range(6):
        for j in range(6):
            damped[i, j] = information[i, j]
        damped[i, i] *= 1.0 + damping


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _try_step(
    step: Array, gradient: Array, rotation: Array, translation: Array, trial_r: Array,
    trial_t: Array,
) -> float:  # fmt: skip
    """Fill the pose after a step; stepᵀ JᵀJ step, since JᵀJ step = Jᵀr."""
    length = 0.0
    for i in range(6):
        length += step[i] * gradient[i]
        trial_t[i % 3] = translation[i % 3] + step[3 + i % 3]
    if length < 1e30:
        so3.perturb_into(step, rotation, trial_r)
    return length


@njit(cache=True, nogil=True, error_model="numpy")
def _add_prior(
    rotation: Array,
    translation: Array,
    prior: Array,
    prior_rotation: Array,
    prior_translation: Array,
    information: Array,
    gradient: Array,
) -> float:
    away = np.empty(6)
    turn = so3.between(rotation, prior_rotation)
    for i in range(3):
        away[i] = turn[i]
        away[3 + i] = translation[i] - prior_translation[i]
    cost = 0.0
    for i in range(6):
        pulled = 0.0
        for j in range(6):
            information[i, j] += prior[i, j]
            pulled += prior[i, j] * away[j]
        gradient[i] -= pulled
        cost += away[i] * pulled
    return cost
