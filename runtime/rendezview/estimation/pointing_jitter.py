"""Pointing jitter of a camera, from the poses of what it sees.

A small turn δ of the camera, new in each reading, turns attitude and place of all it sees alike:
R' = exp(δ) R, t' = exp(δ) t. Motions of the target do not tie the two, nor do errors of a pose
beyond their covariance. So the jitter's variance is the covariance of what attitude and bearing
have in common, beyond a smooth motion:

    u = Σ wᵢ θᵢ,  v = t × Σ wᵢ tᵢ / |t|²,  E u·v = 2 σ² + Σ wᵢ² tr C(θᵢ, tᵢ) [t]×ᵀ / |t|²     (1)

over five readings, with the weights w of a fourth divided difference, Σ w² = 1, that no cubic in
time passes. A jitter far below the error of an attitude shows in v·v first, which a motion of the
target may feign. It counts as far as (1) allows. Jitter about the line of sight shows in attitudes
only, and is looked for where there is jitter across.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose

_READINGS = 5  # Source: by construction, a cubic and one more
_LARGEST_TURN = 1.0  # rad in five readings: beyond, no cubic. Source: by construction
_MEMORY = 400.0  # readings; a camera's mount hardly changes. Source: by construction, ±10 %
# σ of what chance makes of (1), were windows that share readings independent: 4 σ of those that do.
_SURE = 6.5  # Source: white errors without jitter, 400 tracks: 0.2 % of readings show one
# The mean of what a variance may be is by this over the number of windows above its estimate.
# Source: by construction, an inverse gamma distribution of 2 / 3 of a degree of freedom a window
_FEW = 3.0
# sums: number of windows, u·v less its expectation and its variance by chance, the same of v·v, and
# of u² about the line of sight
_COUNT, _SHARED, _CHANCE, _BEARING, _BEARING_CHANCE, _ROLL = range(6)


class PointingJitter:
    """Estimates the variance of the jitter from poses in order of time."""

    def __init__(self) -> None:
        self._times, self._rotations = np.zeros(_READINGS), np.zeros((_READINGS, 3, 3))
        self._places, self._errors = np.zeros((_READINGS, 3)), np.zeros((_READINGS, 6, 6))
        self._sums = np.zeros(6)
        self._held = 0

    def clear(self) -> None:
        """Forget the readings, but not the jitter: it is the camera's."""
        self._held = 0

    def add(self, time_s: float, pose: Pose, covariance: Array) -> None:
        """Take a reading in."""
        for held in (self._times, self._rotations, self._places, self._errors):
            held[:-1] = held[1:].copy()
        self._times[-1], self._rotations[-1] = time_s, pose.rotation
        self._places[-1], self._errors[-1] = pose.translation_m, covariance
        self._held = min(self._held + 1, _READINGS)
        if self._held == _READINGS:
            take(self._times, self._rotations, self._places, self._errors, self._sums)

    @property
    def variances(self) -> tuple[float, float]:
        """rad² an axis across the line of sight and about it; 0 where chance explains it."""
        count, shared, chance, bearing, bearing_chance, roll = self._sums.tolist()
        # A covariance that rounding leaves without a root makes a variance by chance below 0.
        if not (count > 0.0 and chance >= 0.0):
            return 0.0, 0.0
        doubt, share = math.sqrt(chance), (1.0 + _FEW / count) / count
        if shared > _SURE * doubt:
            return 0.5 * share * shared, max(share * roll, 0.0)
        if bearing > _SURE * math.sqrt(bearing_chance):
            across = 0.5 * share * max(min(bearing, shared + _SURE * doubt), 0.0)
            return across, min(max(share * roll, 0.0), across)
        return 0.0, 0.0


def jitter_covariance(variances: tuple[float, float], place_m: Array) -> Array:
    """(6, 6) covariance that jitter adds to a pose at a place, rotation and translation."""
    across, about = variances
    sight = place_m / np.linalg.norm(place_m)
    turn = across * np.eye(3) + (about - across) * np.outer(sight, sight)
    both = np.vstack([np.eye(3), -so3.hat(place_m)])
    return np.asarray(both @ turn @ both.T)


@njit(cache=True, nogil=True, error_model="numpy")
def take(times: Array, rotations: Array, places: Array, errors: Array, sums: Array) -> None:
    """Add five readings to the sums of (1): times (5,), poses, covariances (5, 6, 6)."""
    weights, norm = np.ones(_READINGS), 0.0
    for i in range(_READINGS):
        for j in range(_READINGS):
            if j != i:
                weights[i] /= times[i] - times[j]
        norm += weights[i] ** 2
    last = places[_READINGS - 1]
    far2 = last[0] ** 2 + last[1] ** 2 + last[2] ** 2
    lever = np.zeros((3, 3))  # bearing, as a turn, of a place: [t]× / |t|²
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        lever[k, j], lever[j, k] = last[i] / far2, -last[i] / far2
    attitude, moved, own = np.zeros(3), np.zeros(3), np.zeros((6, 6))
    for i in range(_READINGS):
        w = weights[i] / math.sqrt(norm)
        turn = so3.between(rotations[i], rotations[_READINGS - 1])
        if turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2 > _LARGEST_TURN**2:
            return
        for a in range(3):
            attitude[a] += w * turn[a]
            moved[a] += w * places[i, a]
        for a in range(6):
            for b in range(6):
                own[a, b] += w * w * errors[i, a, b]
    shared, alone = _of_bearing(own, lever)
    product = along = about = chance = excess = excess_chance = 0.0
    for i in range(3):
        turn_of_place = lever[i, 0] * moved[0] + lever[i, 1] * moved[1] + lever[i, 2] * moved[2]
        product += attitude[i] * turn_of_place - shared[i, i]
        excess += turn_of_place**2 - alone[i, i]
        along += attitude[i] * last[i] / math.sqrt(far2)
        for j in range(3):
            excess_chance += 2.0 * alone[i, j] ** 2
            about += last[i] * own[i, j] * last[j] / far2
            chance += own[i, j] * alone[i, j] + shared[i, j] * shared[j, i]
    kept = 1.0 - 1.0 / _MEMORY
    sums[_COUNT] = kept * sums[_COUNT] + 1.0
    sums[_SHARED] = kept * sums[_SHARED] + product
    sums[_CHANCE] = kept * kept * sums[_CHANCE] + chance
    sums[_BEARING] = kept * sums[_BEARING] + excess
    sums[_BEARING_CHANCE] = kept * kept * sums[_BEARING_CHANCE] + excess_chance
    sums[_ROLL] = kept * sums[_ROLL] + along * along - about


@njit(cache=True, nogil=True, error_model="numpy")
def _of_bearing(own: Array, lever: Array) -> tuple[Array, Array]:
    """Covariances (3, 3) of attitude with bearing and of bearing, from those of a pose (6, 6)."""
    shared, alone = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for a in range(3):
                shared[i, j] += own[i, 3 + a] * lever[j, a]
                for b in range(3):
                    alone[i, j] += lever[i, a] * own[3 + a, 3 + b] * lever[j, b]
    return shared, alone
