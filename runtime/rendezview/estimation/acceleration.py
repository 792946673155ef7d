"""Rates of a pose by filters of constant acceleration, which white jerks disturb.

State: attitude, place, angular rate, velocity, angular and linear acceleration. Nobody knows how
freely a target moves: several filters run side by side, each with its own jerk. Each counts as much
as it foretold the last readings, by their turns for the angular rate and by their moves for the
velocity (a static multiple-model estimator; Bar-Shalom, Li & Kirubarajan, *Estimation with
applications to tracking and navigation*, 2001, section 11.6).
Frames and perturbations are those of `rendezview.estimation.motion`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import invert
from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose

_STATES = 18  # Source: by construction, three orders of six


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationOptions:
    """How freely the target may move."""

    # rad/s³ √s of the filters' white angular jerks: a free body, a robot arm, a hand. Source:
    # experiment reflector-rates, from a target at rest to one that swings
    angular_jerks: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0)
    linear_per_angular_m: float = (
        0.3  # m/rad, of the jerks. Source: by construction, an arm's length
    )
    first_rate: float = 0.5  # rad/s, σ before the first reading. Source: by construction
    first_acceleration: float = 0.3  # rad/s², likewise. Source: by construction
    memory: float = 0.9  # of the likelihood, a reading: ten readings count. Source: reflector-rates


@dataclass(frozen=True, slots=True, eq=False)
class MotionRates:
    """Angular rate and velocity (6,), rad/s and m/s, camera frame, with covariance (6, 6)."""

    rates: Array
    covariance: Array


class AccelerationBank:
    """Filters of constant acceleration over poses with covariances, in order of time."""

    def __init__(self, options: AccelerationOptions | None = None) -> None:
        self.options = options or AccelerationOptions()
        count = len(self.options.angular_jerks)
        jerk = np.array(self.options.angular_jerks)
        self._density = np.empty((count, 6))
        self._density[:, :3] = jerk[:, None] ** 2
        self._density[:, 3:] = (self.options.linear_per_angular_m * jerk[:, None]) ** 2
        self._rotations, self._places = np.empty((count, 3, 3)), np.empty((count, 3))
        self._rates = np.zeros((count, 12))
        self._covariances = np.zeros((count, _STATES, _STATES))
        self._scores = np.zeros((count, 2))  # of turns, and of moves
        self._time_s: float | None = None

    def clear(self) -> None:
        """Forget all readings."""
        self._time_s = None

    def add(self, time_s: float, pose: Pose, covariance: Array) -> MotionRates | None:
        """Take a reading in; None for the first."""
        if self._time_s is None:
            self._begin(time_s, pose, covariance)
            return None
        dt, self._time_s = time_s - self._time_s, time_s
        step_filters(
            dt, self._rotations, self._places, self._rates, self._covariances, self._density,
            np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation_m),
            np.ascontiguousarray(covariance), self.options.memory, self._scores,
        )  # fmt: skip
        rates, spread = np.empty(6), np.empty((6, 6))
        if not mix_rates(self._scores, self._rates, self._covariances, rates, spread):
            self._begin(time_s, pose, covariance)
            return None
        return MotionRates(rates, spread)

    def _begin(self, time_s: float, pose: Pose, covariance: Array) -> None:
        options = self.options
        self._time_s = time_s
        self._rotations[:], self._places[:] = pose.rotation, pose.translation_m
        self._rates[:], self._covariances[:], self._scores[:] = 0.0, 0.0, 0.0
        self._covariances[:, :6, :6] = covariance
        scale = np.repeat([1.0, 2.0 * options.linear_per_angular_m], 3)
        for order, sigma in ((6, options.first_rate), (12, options.first_acceleration)):
            self._covariances[:, order : order + 6, order : order + 6] = np.diag(
                (sigma * scale) ** 2
            )


@njit(cache=True, nogil=True, error_model="numpy")
def step_filters(
    dt: float, rotations: Array, places: Array, rates: Array, covariances: Array, density: Array,
    rotation: Array, place: Array, measured: Array, memory: float, scores: Array,
) -> None:  # fmt: skip
    """Predict B filters by ``dt`` and update them with a pose; all arrays change in place.

    Args:
        rotations (B, 3, 3), places (B, 3), rates (B, 12): angular rate, velocity, accelerations.
        covariances: (B, 18, 18) of attitude, place, rates and accelerations.
        density: (B, 6) spectral densities of the white jerks.
        rotation, place, measured: the reading's pose and its covariance (6, 6).
        memory: share of a filter's score that is kept.
        scores: (B, 2) logarithm of its likelihood by the turns and by the moves; NaN where a
            covariance is singular.
    """
    carry, moved = np.eye(_STATES), np.empty(6)
    spread, lower, inverse = np.empty((6, 6)), np.zeros((6, 6)), np.empty((6, 6))
    for b in range(rotations.shape[0]):
        turn = so3.exp(dt * rates[b, :3] + 0.5 * dt * dt * rates[b, 6:9])
        rotations[b] = turn @ rotations[b]
        places[b] += dt * rates[b, 3:6] + 0.5 * dt * dt * rates[b, 9:12]
        rates[b, :6] += dt * rates[b, 6:12]
        carry[:3, :3] = turn
        for i in range(6):
            carry[i, 6 + i] = carry[6 + i, 12 + i] = dt
            carry[i, 12 + i] = 0.5 * dt * dt
        before = carry @ covariances[b] @ carry.T
        for i in range(6):
            q = density[b, i]
            for j, power, share in (
                (0, 5, 20.0), (1, 4, 8.0), (2, 3, 6.0), (4, 3, 3.0), (5, 2, 2.0), (8, 1, 1.0)
            ):  # fmt: skip
                a, c = 6 * (j // 3) + i, 6 * (j % 3) + i
                before[a, c] += q * dt**power / share
                if a != c:
                    before[c, a] += q * dt**power / share
        moved[:3] = so3.between(rotation, rotations[b])
        moved[3:] = place - places[b]
        spread[:] = before[:6, :6] + measured
        if not invert(spread, lower, inverse):
            scores[b] = np.nan
            continue
        for part in range(2):
            scores[b, part] = memory * scores[b, part] + _likely(spread, moved, 3 * part)
        gain = np.ascontiguousarray(before[:, :6]) @ inverse
        change = gain @ moved
        rotations[b] = so3.exp(change[:3]) @ rotations[b]
        places[b] += change[3:6]
        rates[b] += change[6:]
        after = before - gain @ np.ascontiguousarray(before[:6, :])
        covariances[b] = 0.5 * (after + after.T)


@njit(cache=True, nogil=True, error_model="numpy")
def mix_rates(scores: Array, rates: Array, covariances: Array, mean: Array, spread: Array) -> bool:
    """Mean (6,) and covariance (6, 6) of the rates of B filters; false where a score is not finite.

    The angular rate is one filter's and the velocity another's, each with its own weight: they
    correlate where it is the same filter.

    Args:
        scores: (B, 2) logarithms of the filters' likelihoods, by turns and by moves.
        rates, covariances: of the filters, as in `step_filters`.
    """
    count = len(scores)
    weights = np.empty((count, 2))
    mean[:], spread[:] = 0.0, 0.0
    for part in range(2):
        best, total = scores[:, part].max(), 0.0
        for b in range(count):
            if not np.isfinite(scores[b, part]):
                return False
            weights[b, part] = math.exp(scores[b, part] - best)
            total += weights[b, part]
        for b in range(count):
            weights[b, part] /= total
            for i in range(3 * part, 3 * part + 3):
                mean[i] += weights[b, part] * rates[b, i]
    for b in range(count):
        for i in range(6):
            for j in range(6):
                own = covariances[b, 6 + i, 6 + j]
                if i // 3 == j // 3:
                    off = (rates[b, i] - mean[i]) * (rates[b, j] - mean[j])
                    spread[i, j] += weights[b, i // 3] * (own + off)
                else:
                    spread[i, j] += weights[b, 0] * weights[b, 1] * own
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _likely(spread: Array, moved: Array, first: int) -> float:
    """Logarithm of the likelihood of three of the six numbers by which a reading is off."""
    lower, inverse = np.zeros((3, 3)), np.empty((3, 3))
    off = moved[first : first + 3].copy()
    own = np.ascontiguousarray(spread[first : first + 3, first : first + 3])
    if not invert(own, lower, inverse):
        return np.nan
    likely = -0.5 * off @ inverse @ off
    for i in range(3):  # `invert` leaves the factor's own inverse there
        likely += math.log(lower[i, i])
    return float(likely)
