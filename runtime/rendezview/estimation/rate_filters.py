"""The loops of the filters that `rendezview.estimation.rates` describes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into, invert, largest_at
from rendezview.geometry import so3
from rendezview.geometry.pose import Array

STATES = 13  # Source: by construction
_MEAN, _SWING, _CHANGE, _LOG_K = 3, 6, 9, 12  # first state of each, after attitude or place
# Columns of the kinds of motion: rad/s³ √s, rad/s² √s, rad/s (0: none), and σ of the first mean
# (rad/s), swing (rad/s), derivative (rad/s²) and logarithm of k.
JERK, WALK, FREQUENCY, FIRST_MEAN, FIRST_SWING, FIRST_CHANGE, FIRST_LOG_K = range(7)
# rad of a swing in a step: readings do not show a faster one, which fits white pointing errors with
# any amplitude. Source: by construction, four readings a period
_LARGEST_STEP = 0.5 * math.pi
_NEVER = 1e6  # below any score. Source: by construction
_SERIES = 1e-3  # rad of a swing in a step; below it the series. Source: by construction, 1e-13 off
# 1/k: time for which a wrong frequency's jerk keeps its sign. Source: reflector-rates (0.1)
_PERSISTS = 0.2
# of the logarithm of k, a √s. Source: reflector-rates (0.1)
FREQUENCY_WALK = 1e-3
# ln of a likelihood: that far behind, a filter restarts. Source: reflector-rates (0.1)
BEHIND = 12.0


@njit(cache=True, nogil=True, error_model="numpy")
def begin(kind: Array, state: Array, covariance: Array) -> None:
    """Fill state (13,) and covariance (13, 13) of a filter that knows nothing."""
    for i in range(STATES):
        state[i] = 0.0
        for j in range(STATES):
            covariance[i, j] = 0.0
    for first, column in ((_MEAN, FIRST_MEAN), (_SWING, FIRST_SWING), (_CHANGE, FIRST_CHANGE)):
        for i in range(first, first + 3):
            covariance[i, i] = kind[column] ** 2
    if kind[FREQUENCY] > 0.0:
        state[_LOG_K] = math.log(kind[FREQUENCY])
        covariance[_LOG_K, _LOG_K] = kind[FIRST_LOG_K] ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def step_bank(
    dt: float, turns: Array, moves: Array, rotations: Array, places: Array, states: Array,
    covariances: Array, scores: Array, rotation: Array, place: Array, measured: Array,
    kept: float, mean: Array, spread: Array,
) -> bool:  # fmt: skip
    """Predict all filters by ``dt``, update them with a pose, mix their rates.

    Args:
        turns, moves: (B, 7) kinds of the filters.
        rotations (B, 3, 3), places (B, 3), states (2, B, 13), covariances (2, B, 13, 13), scores
            (2, B): of turns and of moves; they change in place.
        rotation, place, measured: the reading's pose and its covariance (6, 6).
        kept: share of the scores that is kept.
        mean, spread: out, (6,) and (6, 6) of angular rate and velocity.

    Returns:
        False where a covariance is singular or a number is not finite: nothing is known.
    """
    step, off, turn, error = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for part in range(2):
        kinds = moves if part else turns
        for i in range(3):
            for j in range(3):
                error[i, j] = measured[3 * part + i, 3 * part + j]
        for b in range(len(kinds)):
            state, covariance = states[part, b], covariances[part, b]
            predict(dt, kinds[b], state, covariance, step)
            so3.exp_into(step, turn)
            if not part:
                carry_attitude(turn, covariance)
            for correction in range(2):  # the step of the prediction, then that of the update
                if correction:
                    scores[part, b] = kept * scores[part, b] + update(
                        off, error, state, covariance, step
                    )
                _move(part, step, rotation, place, rotations[b], places[b], off)
            if not math.isfinite(scores[part, b]):
                return False
            if kinds[b, FREQUENCY] > 0.0 and math.exp(state[_LOG_K]) * dt > _LARGEST_STEP:
                scores[part, b] = -_NEVER
        best = largest_at(scores[part])
        mix(scores[part], states[part], covariances[part], 3 * part, mean, spread)
        for b in range(len(kinds)):
            if scores[part, b] < scores[part, best] - BEHIND:
                restart(kinds[b], best, b, states[part], covariances[part])
                scores[part, b] = scores[part, best] - 0.7 * BEHIND
                copy_into(places[best if part else b], places[b])
                copy_matrix_into(rotations[b if part else best], rotations[b])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _move(
    part: int, step: Array, rotation: Array, place: Array, own_rotation: Array, own_place: Array,
    off: Array,
) -> None:  # fmt: skip
    """Turn (part 0) or move (1) a filter's own pose by a step; ``off``: how far a reading is."""
    if part:
        for i in range(3):
            own_place[i] += step[i]
            off[i] = place[i] - own_place[i]
        return
    turned = np.empty((3, 3))
    so3.perturb_into(step, own_rotation, turned)
    copy_matrix_into(turned, own_rotation)
    copy_into(so3.between(rotation, turned), off)


@njit(cache=True, nogil=True, error_model="numpy")
def transition(dt: float, k: float, carry: Array, slope: Array) -> None:
    """Fill how a swing and its derivative act on place, swing and derivative after ``dt``.

    ``carry`` (3, 2), and its derivative ``slope`` (3, 2) by the logarithm of k. The swing's
    equation has the solution swing cos kt + derivative sin kt / k.
    """
    w = k * dt
    if w > _SERIES:
        c, s, half = math.cos(w), math.sin(w), math.sin(0.5 * w)
        less = 2.0 * half * half  # 1 − cos
        carry[0, 0], carry[0, 1] = s / k, less / (k * k)
        carry[1, 0], carry[1, 1] = c, s / k
        carry[2, 0], carry[2, 1] = -k * s, c
        slope[0, 0], slope[0, 1] = dt * c - s / k, (w * s - 2.0 * less) / (k * k)
        slope[1, 0], slope[1, 1] = -w * s, dt * c - s / k
        slope[2, 0], slope[2, 1] = -k * s - k * w * c, -w * s
    else:
        carry[0, 0], carry[0, 1] = dt, 0.5 * dt * dt
        carry[1, 0], carry[1, 1] = 1.0 - 0.5 * w * w, dt
        carry[2, 0], carry[2, 1] = -k * w, 1.0 - 0.5 * w * w
        slope[0, 0], slope[0, 1] = -w * w * dt / 3.0, -w * w * dt * dt / 12.0
        slope[1, 0], slope[1, 1] = -w * w, -w * w * dt / 3.0
        slope[2, 0], slope[2, 1] = -2.0 * k * w, -w * w


@njit(cache=True, nogil=True, error_model="numpy")
def predict(dt: float, kind: Array, state: Array, covariance: Array, step: Array) -> None:
    """Predict one filter; ``step`` (3,): the turn or the move, which the caller applies."""
    swings = kind[FREQUENCY] > 0.0
    k = math.exp(state[_LOG_K]) if swings else 0.0
    jerks = kind[JERK] ** 2
    if swings:  # of second order in the errors of swing and frequency
        unsure, size, doubt = covariance[_LOG_K, _LOG_K], 0.0, 0.0
        for i in range(_SWING, _SWING + 3):
            size += state[i] ** 2 / 3.0
            doubt += covariance[i, i] / 3.0
        jerks += _PERSISTS * 4.0 * k**3 * unsure * (doubt + unsure * size)
    carry, slope = np.empty((3, 2)), np.empty((3, 2))
    transition(dt, k, carry, slope)
    turned = np.zeros((3, 3))  # derivatives of place, swing and derivative by the frequency
    moved = np.empty((3, 3))
    for r in range(3):
        for i in range(3):
            h, a = state[_SWING + i], state[_CHANGE + i]
            moved[r, i] = carry[r, 0] * h + carry[r, 1] * a
            if swings:
                turned[r, i] = slope[r, 0] * h + slope[r, 1] * a
    for i in range(3):
        step[i] = dt * state[_MEAN + i] + moved[0, i]
        state[_SWING + i], state[_CHANGE + i] = moved[1, i], moved[2, i]
    for j in range(STATES):  # rows: F P
        _carry(dt, carry, turned, covariance[:, j])
    for j in range(STATES):  # columns: (F P) Fᵀ
        _carry(dt, carry, turned, covariance[j])
    walks = kind[WALK] ** 2
    for i in range(3):
        for r, c, power, share in (
            (0, 0, 5, 20.0), (0, 2, 4, 8.0), (0, 3, 3, 6.0), (2, 2, 3, 3.0), (2, 3, 2, 2.0),
            (3, 3, 1, 1.0),
        ):  # fmt: skip
            _disturb(covariance, 3 * r + i, 3 * c + i, jerks * dt**power / share)
        for r, c, power, share in ((0, 0, 3, 3.0), (0, 1, 2, 2.0), (1, 1, 1, 1.0)):
            _disturb(covariance, 3 * r + i, 3 * c + i, walks * dt**power / share)
    if swings:
        covariance[_LOG_K, _LOG_K] += FREQUENCY_WALK**2 * dt


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _disturb(covariance: Array, i: int, j: int, more: float) -> None:
    covariance[i, j] += more
    if i != j:
        covariance[j, i] += more


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _carry(dt: float, carry: Array, turned: Array, v: Array) -> None:
    """Apply the transition to one vector (13,) of errors, in place."""
    f = v[_LOG_K]
    for i in range(3):
        h, a = v[_SWING + i], v[_CHANGE + i]
        v[i] += dt * v[_MEAN + i] + carry[0, 0] * h + carry[0, 1] * a + turned[0, i] * f
        v[_SWING + i] = carry[1, 0] * h + carry[1, 1] * a + turned[1, i] * f
        v[_CHANGE + i] = carry[2, 0] * h + carry[2, 1] * a + turned[2, i] * f


@njit(cache=True, nogil=True, error_model="numpy")
def carry_attitude(turn: Array, covariance: Array) -> None:
    """Turn the errors of the attitude by the rotation (3, 3) of a step.

    The transition has added what the rates' errors do: they are those of the camera frame, and the
    turn within a step is small beside them.
    """
    for j in range(STATES):
        a, b, c = covariance[0, j], covariance[1, j], covariance[2, j]
        for i in range(3):
            covariance[i, j] = turn[i, 0] * a + turn[i, 1] * b + turn[i, 2] * c
    for j in range(STATES):
        a, b, c = covariance[j, 0], covariance[j, 1], covariance[j, 2]
        for i in range(3):
            covariance[j, i] = turn[i, 0] * a + turn[i, 1] * b + turn[i, 2] * c


@njit(cache=True, nogil=True, error_model="numpy")
def update(off: Array, error: Array, state: Array, covariance: Array, step: Array) -> float:
    """Update one filter with a reading that is ``off`` (3,); logarithm of its likelihood.

    ``error`` (3, 3): covariance of the reading. ``step`` (3,): correction of attitude or place,
    which the caller applies. NaN where a covariance is singular.
    """
    lower, inverse = np.zeros((3, 3)), np.empty((3, 3))
    likely = -0.5 * _far_off(off, error, covariance, lower, inverse)
    for i in range(3):  # `invert` leaves the factor's own inverse there
        likely += math.log(lower[i, i])
    gain, before = np.zeros((STATES, 3)), np.empty((3, STATES))
    copy_matrix_into(covariance[:3], before)
    for i in range(STATES):
        change = 0.0
        for j in range(3):
            for m in range(3):
                gain[i, j] += before[m, i] * inverse[m, j]
            change += gain[i, j] * off[j]
        if i < 3:
            step[i] = change
        else:
            state[i] += change
    for i in range(STATES):
        for j in range(i + 1):
            less = gain[i, 0] * before[0, j] + gain[i, 1] * before[1, j] + gain[i, 2] * before[2, j]
            covariance[i, j] = covariance[j, i] = covariance[i, j] - less
    return likely


@njit(cache=True, nogil=True, error_model="numpy")
def _far_off(off: Array, error: Array, covariance: Array, lower: Array, inverse: Array) -> float:
    """Squared distance of a reading ``off`` (3,) from a prediction, in standard deviations.

    Fills the inverse (3, 3) of both covariances' sum and of its factor. NaN where it is singular.
    """
    spread, total = np.empty((3, 3)), 0.0
    for i in range(3):
        for j in range(3):
            spread[i, j] = covariance[i, j] + error[i, j]
    if not invert(spread, lower, inverse):
        return np.nan
    for i in range(3):
        for j in range(3):
            total += off[i] * inverse[i, j] * off[j]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def mix(
    scores: Array, states: Array, covariances: Array, first: int, mean: Array, spread: Array
) -> None:
    """Add mean and covariance of the rates of B filters, weighted by their scores.

    To the three elements of ``mean`` from ``first`` on, and to their block of ``spread``.
    """
    count, total, best = len(scores), 0.0, scores[largest_at(scores)]
    weights, rates = np.empty(count), np.empty((count, 3))
    for b in range(count):
        weights[b] = math.exp(scores[b] - best)
        total += weights[b]
    for b in range(count):
        weights[b] /= total
        for i in range(3):
            rates[b, i] = states[b, _MEAN + i] + states[b, _SWING + i]
            mean[first + i] += weights[b] * rates[b, i]
    for b in range(count):
        for i in range(3):
            for j in range(3):
                own = (rates[b, i] - mean[first + i]) * (rates[b, j] - mean[first + j])
                own += _rate_error(covariances[b], i, j)
                spread[first + i, first + j] += weights[b] * own


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _rate_error(covariance: Array, i: int, j: int) -> float:
    """Covariance of the rates about two axes, mean and swing together."""
    m, s = _MEAN, _SWING
    own = covariance[m + i, m + j] + covariance[s + i, s + j]
    return float(own + covariance[m + i, s + j] + covariance[s + i, m + j])


@njit(cache=True, nogil=True, error_model="numpy")
def restart(kind: Array, best: int, b: int, states: Array, covariances: Array) -> None:
    """Start filter ``b`` anew from the best one's attitude or place, rate and acceleration.

    How a rate is shared between mean and swing is not known of the new one.
    """
    source, known = states[best], covariances[best]
    state, covariance = states[b], covariances[b]
    begin(kind, state, covariance)
    steady, mean = kind[FIRST_SWING] == 0.0, kind[FIRST_MEAN] > 0.0
    for i in range(3):
        state[(_MEAN if mean else _SWING) + i] = source[_MEAN + i] + source[_SWING + i]
        if not steady:
            state[_CHANGE + i] = source[_CHANGE + i]
        for j in range(3):
            covariance[i, j] = known[i, j]
            rate = _rate_error(known, i, j)
            apart = covariance[_SWING + i, _SWING + j] if mean else 0.0
            if mean:
                covariance[_MEAN + i, _MEAN + j] = rate + apart
                covariance[_MEAN + i, _SWING + j] = covariance[_SWING + i, _MEAN + j] = -apart
            else:
                covariance[_SWING + i, _SWING + j] = rate
            if not steady:
                covariance[_CHANGE + i, _CHANGE + j] = known[_CHANGE + i, _CHANGE + j]


@njit(cache=True, nogil=True, error_model="numpy")
def surprise(
    dt: float, turns: Array, moves: Array, rotations: Array, places: Array, states: Array,
    covariances: Array, scores: Array, rotation: Array, place: Array, measured: Array,
) -> float:  # fmt: skip
    """χ² of a pose against the filters' predictions, which stay as they are; see `step_bank`.

    Of each part the likeliest filter counts: others would allow anything after a gap. Neither a
    turn of the camera nor a move across is a surprise: the place is put on the bearing predicted,
    and the attitude counts as it is or turned along, whichever is nearer.
    """
    state, errors, steps = np.empty(STATES), np.empty((2, STATES, STATES)), np.empty((2, 3))
    turn, own, own_at, off = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    lower, inverse = np.zeros((3, 3)), np.empty((3, 3))
    for part in range(2):
        best = largest_at(scores[part])
        copy_into(states[part, best], state)
        copy_matrix_into(covariances[part, best], errors[part])
        kind = moves[best] if part else turns[best]
        predict(dt, kind, state, errors[part], steps[part])
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
    least = _far_off(off, measured[:3, :3], errors[0], lower, inverse)
    copy_into(so3.between(aimed, own), off)
    least = min(least, _far_off(off, measured[:3, :3], errors[0], lower, inverse))
    for i in range(3):
        off[i] = aimed_at[i] - own_at[i]
    return least + _far_off(off, measured[3:, 3:], errors[1], lower, inverse)


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
