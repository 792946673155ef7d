"""Rates of a pose, by filters that each know one kind of motion.

How a target moves is unknown. Filters of three kinds run side by side: steady rates;
accelerations that change at random; and rates that swing about a mean, with one unknown period for
all three axes. The last is the exact motion of a pendulum, of a point of a turning body, and of the
angular rate of a free body with an axis of symmetry. Other free bodies come near to it.

Turns and moves are filtered apart, with 13 states for three numbers: attitude or place, mean rate,
swing about it, the swing's derivative, and the logarithm of its angular frequency k:
ω = mean + swing, d²swing/dt² = −k² swing. Where k is 0 the swing is a rate that the derivative
changes. White jerks disturb the derivative, white accelerations steady rates. A wrong k is a jerk,
too: the covariance's part of second order is added to the jerks' density.

Each filter counts as much as it foretold the readings of the last seconds (a multiple-model
estimator; Bar-Shalom, Li & Kirubarajan, *Estimation with applications to tracking and navigation*,
2001, section 11.6). One that falls far behind restarts from the best.

A camera's pointing jitter is noise of the poses that their covariances do not hold. It is estimated
(`rendezview.estimation.pointing_jitter`) and added. Where the estimate grows, filters that trusted
the first readings too much go through the last ones again.

An error that hardly changes from reading to reading, as that of a spot over which an edge creeps,
does not average down. It counts as white noise of the same spectral density: 2 τ / dt times the
variance for a correlation time τ. Before it was noticed it was there, too: readings shortly before
are widened alike.
Frames and perturbations are those of `rendezview.estimation.motion`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from rendezview.estimation.pointing_jitter import PointingJitter, jitter_covariance
from rendezview.estimation.rate_filters import (
    FIRST_CHANGE,
    FIRST_MEAN,
    FIRST_SWING,
    JERK,
    STATES,
    WALK,
    begin,
    step_bank,
    surprise,
)
from rendezview.estimation.slow_error import SlowError
from rendezview.geometry.pose import Array, Pose

# Readings that are kept to go through again: 7 s at 30 Hz. Source: by construction, a bound of time
_KEPT = 200
_CHANGED = 1.5  # × the variance of the jitter: again. Source: by construction, a fifth of its σ


# Of the filters, how freely the target may move; numbers of turns, and for moves times a length.
# rad/s² √s of white accelerations. Source: reflector-rates (0.1), a free body, a drive
_STEADY_WALKS = (1e-4, 1e-3)
# rad/s³ √s of white jerks. Source: experiment reflector-rates (0.1), a robot's arm to a hand
_JERKS = (1e-1, 1.0)
# rad/s of swings, periods of 42 to 2.6 s; each estimates its own. Source: reflector-rates (0.1)
_FREQUENCIES = (0.15, 0.3, 0.6, 1.2, 2.4)
_FREQUENCY_SPREAD = 0.35  # of the logarithm: half the step. Source: by construction
_SWING_JERK = 1e-4  # rad/s³ √s of the swings. Source: reflector-rates (0.1)
_LINEAR_PER_ANGULAR_M = 0.3  # m/rad. Source: by construction, an arm's length
_RATE = 0.5  # rad/s, σ before the first reading. Source: by construction
_CHANGE = 0.3  # rad/s², likewise. Source: by construction
_MEMORY_S = 10.0  # s, of the likelihoods. Source: experiment reflector-rates (0.1)


def _kinds() -> Array:
    """(B, 7) the filters, a row each."""
    half = math.sqrt(0.5) * _RATE
    steady = [(0.0, walk, 0.0, _RATE, 0.0, 0.0, 0.0) for walk in _STEADY_WALKS]
    pushed = [(jerk, 0.0, 0.0, 0.0, _RATE, _CHANGE, 0.0) for jerk in _JERKS]
    swinging = [(_SWING_JERK, 0.0, k, half, half, _CHANGE, _FREQUENCY_SPREAD) for k in _FREQUENCIES]
    return np.array(steady + pushed + swinging)


TURNS, MOVES = _kinds(), _kinds()
MOVES[:, [JERK, WALK, FIRST_MEAN, FIRST_SWING, FIRST_CHANGE]] *= _LINEAR_PER_ANGULAR_M


@dataclass(frozen=True, slots=True, eq=False)
class MotionRates:
    """Angular rate and velocity (6,), rad/s and m/s, camera frame, with covariance (6, 6).

    Errors of the angular rate and of the velocity are taken as uncorrelated.
    """

    rates: Array
    covariance: Array


class RateBank:
    """The filters of one target over poses with covariances, in order of time."""

    def __init__(self) -> None:
        count = len(TURNS)
        self._rotations, self._places = np.empty((count, 3, 3)), np.empty((count, 3))
        self._states = np.zeros((2, count, STATES))
        self._covariances = np.zeros((2, count, STATES, STATES))
        self._scores = np.zeros((2, count))  # logarithms of likelihoods
        self._time_s: float | None = None
        self._jitter, self._trusted = PointingJitter(), 0.0  # rad² of the jitter held for true
        self._slow = SlowError()
        self._readings: deque[tuple[float, Pose, Array]] = deque(maxlen=_KEPT)

    def clear(self) -> None:
        """Forget all readings, but not the camera's jitter."""
        self._time_s = None
        self._jitter.clear()
        self._slow.clear()
        self._readings.clear()

    def add(
        self, time_s: float, pose: Pose, covariance: Array, slow: Array | None = None
    ) -> MotionRates | None:
        """Take a reading in; None for the first.

        ``slow`` (6, 6): the part of the covariance whose error hardly changes between readings.
        """
        self._jitter.add(time_s, pose, covariance)
        began = False
        if slow is not None:
            more, began = self._slow.add(time_s, slow)
            covariance = covariance if more is None else covariance + more
            if began:
                widened = self._slow.widened(time_s, slow, self._readings)
                self._readings = deque(widened, maxlen=_KEPT)
        self._readings.append((time_s, pose, covariance))
        across = self._jitter.variances[0]
        steady = self._trusted <= _CHANGED * across and across <= _CHANGED * self._trusted
        if steady and not began:
            return self._step(time_s, pose, covariance)
        self._trusted, self._time_s, found = across, None, None
        for reading in self._readings:
            found = self._step(*reading)
        return found

    def surprise(self, time_s: float, pose: Pose, covariance: Array) -> float:
        """χ² (of six) of a pose against the motion so far, which it does not change; 0: unknown.

        Neither a turn of the camera nor a move across the line of sight is a surprise.
        """
        if self._time_s is None or len(self._readings) < 2:
            return 0.0
        variances = self._jitter.variances
        if variances[0] > 0.0:
            covariance = covariance + jitter_covariance(variances, pose.translation_m)
        return float(surprise(
            time_s - self._time_s, TURNS, MOVES, self._rotations, self._places, self._states,
            self._covariances, self._scores, pose.rotation.copy(), pose.translation_m.copy(),
            np.ascontiguousarray(covariance),
        ))  # fmt: skip

    def _step(self, time_s: float, pose: Pose, covariance: Array) -> MotionRates | None:
        """Predict and update with one reading."""
        variances = self._jitter.variances
        if variances[0] > 0.0:
            covariance = covariance + jitter_covariance(variances, pose.translation_m)
        if self._time_s is None:
            self._begin(time_s, pose, covariance)
            return None
        dt, self._time_s = time_s - self._time_s, time_s
        rates, spread = np.zeros(6), np.zeros((6, 6))
        kept = math.exp(-max(dt, 0.0) / _MEMORY_S)
        sound = step_bank(
            dt, TURNS, MOVES, self._rotations, self._places, self._states,
            self._covariances, self._scores, pose.rotation.copy(), pose.translation_m.copy(),
            np.ascontiguousarray(covariance), kept, rates, spread,
        )  # fmt: skip
        if not sound:
            self._begin(time_s, pose, covariance)
            return None
        return MotionRates(rates, spread)

    def _begin(self, time_s: float, pose: Pose, covariance: Array) -> None:
        self._time_s = time_s
        self._rotations[:], self._places[:] = pose.rotation, pose.translation_m
        self._scores[:] = 0.0
        for part, kinds in enumerate((TURNS, MOVES)):
            own = slice(3 * part, 3 * part + 3)
            for b in range(len(kinds)):
                begin(kinds[b], self._states[part, b], self._covariances[part, b])
                self._covariances[part, b, :3, :3] = covariance[own, own]
