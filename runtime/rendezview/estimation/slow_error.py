"""Errors of poses that hardly change from one reading to the next, as white noise.

A first-order Gauss–Markov process of variance σ² and correlation time τ has at low frequencies the
spectral density 2 σ² τ: that of white noise of variance σ² 2 τ / dt in readings dt apart. An error
of two readings in a row counts, one of a single reading is chance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from rendezview.geometry.pose import Array, Pose

_SLOW_S = 1.0  # s, correlation time. Source: by construction, how fast an edge creeps is not known
# × the variance of one that begins: an error so small is forgotten. Source: by construction, 7 s
_FORGOTTEN = 1e-3

Reading = tuple[float, Pose, Array]  # time, pose, covariance (6, 6)


class SlowError:
    """The slow error of the last readings."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget it."""
        self._held, self._size, self._time_s = np.zeros((6, 6)), 0.0, math.nan
        self._was = False

    def add(self, time_s: float, slow: Array) -> tuple[Array | None, bool]:
        """Take the slow part (6, 6) of a reading's covariance in.

        Returns:
            What to add to the covariance, (6, 6) or None, and whether the error has begun.
        """
        step_s, self._time_s = time_s - self._time_s, time_s
        size, was = float(slow.trace()), self._was
        self._was = size > 0.0
        if not (math.isfinite(step_s) and (was or self._size > 0.0)):
            return None, False
        kept = math.exp(-step_s / _SLOW_S)
        self._held, self._size = kept * self._held, kept * self._size
        began = was and self._size < _FORGOTTEN * size
        if was and size > self._size:
            self._held, self._size = slow.copy(), size
        return max(_repeats(step_s) - 1.0, 0.0) * self._held, began

    @staticmethod
    def widened(time_s: float, slow: Array, readings: Iterable[Reading]) -> Iterator[Reading]:
        """The readings, those shortly before a time with a slow error that nobody noticed."""
        before_s = -math.inf
        for then_s, pose, covariance in readings:
            if time_s - then_s <= _SLOW_S:
                covariance = covariance + max(_repeats(then_s - before_s), 1.0) * slow
            yield then_s, pose, covariance
            before_s = then_s


def _repeats(step_s: float) -> float:
    """Readings, so far apart, in which the error is about the same."""
    return 2.0 * _SLOW_S / step_s
