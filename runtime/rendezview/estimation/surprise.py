"""How far a pose is from what the filters of `rendezview.estimation.rates` predict."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into, invert, largest_at
from rendezview.estimation.rate_filters import STATES, carry_attitude, predict
from rendezview.geometry import so3
from rendezview.geometry.pose import Array


@njit(cache=True, nogil=True, error_model="numpy")
def surprise(
    dt: float, turns: Array, moves: Array, rotations: Array, places: Array, states: Array,
    covariances: Array, scores: Array, rotation: Array, place: Array, measured: Array,
    frequency_walk: float,
) -> float:  # fmt: skip
    """χ² of a pose against the filters' predictions, which stay as they are; see
    `rate_filters.step_bank`.

    Of each part the likeliest filter counts: others would allow anything after a gap. Neither a
    turn of the camera nor a move across is a surprise: the place is put on the bearing predicted,
    and the attitude counts as it is or turned along, whichever is nearer.
    """
    state, errors, steps = np.empty(STATES), np.empty((2, STATES, STATES)), np.empty((2, 3))
    turn, own, own_at, off = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for part in range(2):
        best = largest_at(scores[part])
        copy_into(states[part, best], state)
        copy_matrix_into(covariances[part, best], errors[part])
        kind = moves[best] if part else turns[best]
        predict(dt, kind, frequency_walk, state, errors[part], steps[part])
        if part:
            for i in range(3):
                own_at[i] = places[best, i] + steps[1, i]
        else:
            so3.exp_into(steps[0], turn)
            carry_attitude(turn, errors[0])
            so3.perturb_into(steps[0], rotations[best], own)
    aimed, aimed_at = rotation.copy(), place.copy()
    _aim(aimed, aimed_at, own_at)
    copy_into(so3.between(rotation, own), off)
    least = _far(off, measured[:3, :3], errors[0])
    copy_into(so3.between(aimed, own), off)
    least = min(least, _far(off, measured[:3, :3], errors[0]))
    for i in range(3):
        off[i] = aimed_at[i] - own_at[i]
    return least + _far(off, measured[3:, 3:], errors[1])


@njit(cache=True, nogil=True, error_model="numpy")
def _aim(rotation: Array, place: Array, sight: Array) -> None:
    """Turn a pose by the least that brings its place onto a line of sight."""
    far = math.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2)
    scale = far / math.sqrt(sight[0] ** 2 + sight[1] ** 2 + sight[2] ** 2)
    axis, turned = np.empty(3), np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axis[i] = (place[j] * sight[k] - place[k] * sight[j]) * scale / (far * far)
    sine = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    if sine > 0.0:
        for i in range(3):
            axis[i] *= math.asin(min(sine, 1.0)) / sine
    so3.perturb_into(axis, rotation, turned)
    copy_matrix_into(turned, rotation)
    for i in range(3):
        place[i] = scale * sight[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _far(off: Array, error: Array, covariance: Array) -> float:
    """Squared distance of a reading ``off`` (3,) from a prediction, in standard deviations."""
    lower, inverse, spread = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            spread[i, j] = covariance[i, j] + error[i, j]
    if not invert(spread, lower, inverse):
        return 0.0
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += off[i] * inverse[i, j] * off[j]
    return total
