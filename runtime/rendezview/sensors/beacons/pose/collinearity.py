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

from rendezview.estimation.least_squares import (
    DAMPING_DECAY,
    DAMPING_GROWTH,
    FIRST_DAMPING,
    ROUNDING,
    damped_step,
)
from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into
from rendezview.geometry import so3

Array = npt.NDArray[np.float64]

_NEAREST = 1e-9  # metres in front of a camera. Source: by construction, no division by 0


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    rotation: Array, translation: Array, leds: Array, cr: Array, ct: Array, xy: Array,
    weight: Array, information: Array, gradient: Array,
) -> float:  # fmt: skip
    """Fill JᵀJ (6, 6) and Jᵀr (6,) of the weighted equations; returns the sum of squares.

    Residual: observed less predicted, over σ. Infinite where a light is behind a camera.
    """
    cost, arm, q, row = 0.0, np.empty(3), np.empty(3), np.empty(6)
    information[:], gradient[:] = 0.0, 0.0
    for j in range(leds.shape[0]):
        so3.rotate_into(rotation, leds[j], arm)
        for k in range(cr.shape[0]):
            if weight[k, j, 0] == 0.0:
                continue
            so3.rotate_into(cr[k], arm + translation, q)
            z = q[2] + ct[k, 2]
            if not z > _NEAREST:
                return np.inf
            for i in range(2):
                x = (q[i] + ct[k, i]) / z  # eq. 4
                r = weight[k, j, i] * (xy[k, j, i] - x)
                for a in range(3):
                    row[3 + a] = weight[k, j, i] / z * (cr[k, i, a] - x * cr[k, 2, a])
                for a in range(3):  # d p / d(rotation vector) = −[R p]×, so the row is (R p) × g
                    b, c = (a + 1) % 3, (a + 2) % 3
                    row[a] = arm[b] * row[3 + c] - arm[c] * row[3 + b]
                cost += r * r
                for a in range(6):
                    gradient[a] += row[a] * r
                    for b in range(6):
                        information[a, b] += row[a] * row[b]
    return cost


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
    lower, trial_information = np.empty((6, 6)), np.empty((6, 6))
    trial_r, trial_t, damping = np.empty((3, 3)), np.empty(3), 0.0
    cost = _cost_at(
        rotation, translation, leds, cr, ct, xy, weight, prior, prior_rotation, prior_translation,
        information, gradient,
    )  # fmt: skip
    if not cost < np.inf:
        return np.inf, 0, False
    for taken in range(1, iterations + 1):
        while True:
            if damping > 1e9 or not information[0, 0] > 0.0:
                return cost, taken, False
            if not damped_step(information, gradient, damping, lower, step):
                damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
                continue
            length = 0.0  # stepᵀ JᵀJ step, since JᵀJ step = Jᵀr
            for i in range(6):
                length += step[i] * gradient[i]
                trial_t[i % 3] = translation[i % 3] + step[3 + i % 3]
            if not length < 1e30:
                return cost, taken, False
            so3.perturb_into(step, rotation, trial_r)
            if length < tolerance * tolerance and damping < 1e-2:
                copy_matrix_into(trial_r, rotation)
                copy_into(trial_t, translation)
                return cost - length, taken, True  # so short a step is as good as linear
            trial = _cost_at(
                trial_r, trial_t, leds, cr, ct, xy, weight, prior, prior_rotation,
                prior_translation, trial_information, trial_gradient,
            )  # fmt: skip
            if trial <= cost * (1.0 + ROUNDING) + 1e-12 or (iterations == 1 and trial < np.inf):
                break
            damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        copy_matrix_into(trial_r, rotation)
        copy_into(trial_t, translation)
        copy_matrix_into(trial_information, information)
        copy_into(trial_gradient, gradient)
        cost, damping = trial, DAMPING_DECAY * damping if damping > 1e-6 else 0.0
    return cost, iterations, False


@njit(cache=True, nogil=True, error_model="numpy")
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
        turn, away = so3.between(rotation, prior_rotation), np.empty(6)
        for i in range(3):
            away[i], away[3 + i] = turn[i], translation[i] - prior_translation[i]
        for i in range(6):
            pulled = 0.0
            for j in range(6):
                information[i, j] += prior[i, j]
                pulled += prior[i, j] * away[j]
            gradient[i] -= pulled
            cost += away[i] * pulled
    return cost
