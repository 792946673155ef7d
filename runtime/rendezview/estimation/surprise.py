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
    aimed, aimed_at, step = rotation.copy(), place.copy(), np.empty(3)
    state, covariance, own_at = np.empty(STATES), np.empty((STATES, STATES)), np.empty(3)
    bests = largest_at(scores[0]), largest_at(scores[1])
    copy_into(states[1, bests[1]], state)
    copy_matrix_into(covariances[1, bests[1]], covariance)
    predict(dt, moves[bests[1]], frequency_walk, state, covariance, step)
    for i in range(3):
        own_at[i] = places[bests[1], i] + step[i]
    _aim(aimed, aimed_at, own_at)
    total = 0.0
    for part in range(2):
        kinds, best = moves if part else turns, bests[part]
        total += _from_filter(
            part, dt, kinds[best], frequency_walk, states[part, best], covariances[part, best],
            rotations[best], places[best], (rotation, aimed), aimed_at, measured,
        )  # fmt: skip
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _from_filter(
    part: int, dt: float, kind: Array, frequency_walk: float, state: Array, covariance: Array,
    rotation: Array, place: Array, turned: tuple[Array, Array], moved: Array, measured: Array,
) -> float:  # fmt: skip
    """Least squared distance of two attitudes (part 0), or that of a place, from a prediction."""
    state, covariance, step, off = state.copy(), covariance.copy(), np.empty(3), np.empty(3)
    turn, error, own = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    predict(dt, kind, frequency_walk, state, covariance, step)
    if not part:
        so3.exp_into(step, turn)
        carry_attitude(turn, covariance)
    least = np.inf
    for i in range(3):
        for j in range(3):
            error[i, j] = measured[3 * part + i, 3 * part + j]
    for k in range(2 - part):
        if part:
            for i in range(3):
                off[i] = moved[i] - place[i] - step[i]
        else:
            so3.perturb_into(step, rotation, own)
            copy_into(so3.between(turned[k], own), off)
        least = min(least, _far(off, error, covariance))
    return least


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
