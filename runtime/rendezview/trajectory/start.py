"""Starting values of a fit: closed-form least squares."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import cholesky, copy_into, quantile, substitute
from rendezview.geometry.pose import Array
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.shapes import SPIRAL, basis, frame_of

# Of hops that are tried, from an eighth of the segment to twice it.
_PERIODS = 24  # Source: by construction, a grid
_PHASES = 8  # Source: by construction, a grid
# Of weights after outliers. Source: experiment trajectory-methods (0.1), seed 1
_ROUNDS = 3
# Times the median squared distance: half weight. 12 σ² over the median of χ² of three degrees.
_CUT_MEDIANS = 5.0  # Source: by construction


def first_guess(
    code: int, times_s: Array, places_m: Array, weights: Array, mean_motion_rad_s: float
) -> tuple[Array, Array] | NoFit:
    """Base (3, 3) and parameters (P,) of a shape; times (N,) from the middle of the segment."""
    if code <= SPIRAL:
        return _around(code, times_s, places_m, weights)
    matrix = basis(code, times_s, mean_motion_rad_s)
    root = np.sqrt(weights)[:, None]
    # Columns of one size, so that metres and metres a second weigh alike.
    flat = (matrix * root[:, :, None]).reshape(-1, matrix.shape[2])
    size = np.linalg.norm(flat, axis=0)
    if not np.all(size > 0.0):
        return NoFit("the points span no time")
    answer = np.linalg.lstsq(flat / size, (places_m * root).reshape(-1), rcond=None)[0]
    return np.eye(3), np.asarray(answer / size)


def _around(
    code: int, times_s: Array, places_m: Array, weights: Array
) -> tuple[Array, Array] | NoFit:
    """The plane through the centre nearest to all places, and the phase against time."""
    far = np.linalg.norm(places_m, axis=1)
    directions = places_m / far[:, None]
    scatter = (weights[:, None] * directions).T @ directions
    normal = np.linalg.eigh(scatter)[1][:, 0]
    first = np.flatnonzero(np.concatenate([[True], np.diff(times_s) > 0.0]))
    total = np.maximum(np.add.reduceat(weights, first), 1e-12)
    mean = np.add.reduceat(weights[:, None] * directions, first) / total[:, None]
    middle = mean[np.argmin(np.abs(times_s[first]))]
    if np.linalg.norm(middle - (middle @ normal) * normal) < 1e-6:
        return NoFit("the points lie on no path about the target")
    base = frame_of(normal, middle)
    phase = np.unwrap(np.arctan2(mean @ base[:, 1], mean @ base[:, 0]))
    rate, offset = np.polyfit(times_s[first], phase, 1)
    if rate < 0.0:  # the other way round is about the opposite normal
        base, rate, offset = base * [1.0, -1.0, -1.0], -rate, -offset
    c, s = np.cos(offset), np.sin(offset)
    base = base @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    climb, radius = np.polyfit(times_s, far, 1)
    if code == SPIRAL:
        return base, np.array([0.0, 0.0, 0.0, radius, rate, climb])
    return base, np.array([0.0, 0.0, 0.0, float(np.median(far)), rate])


def hops_of(
    times_s: Array, places_m: Array, weights: Array, closing: float, *, robust: bool = False
) -> Array | None:
    """(11,) parameters of a line with hops: the best of many periods and phases.

    For each the line and the hop are linear: three basis functions, worked out for all three
    axes together. None where no period has enough points.

    Args:
        times_s: (N,) from the middle of the segment.
        places_m: (N, 3).
        weights: (N,).
        closing: rate over the distance, 1/s.
        robust: three rounds of weights after Geman and McClure for each period and phase.
    """
    span = float(times_s[-1] - times_s[0])
    periods = span * np.geomspace(0.125, 2.0, _PERIODS)
    rounds = _ROUNDS if robust else 0
    found = _scan_hops(times_s, places_m, weights, closing, periods, _PHASES, rounds)
    if not np.isfinite(found).all():
        return None
    return np.asarray(found)


@njit(cache=True, nogil=True, error_model="numpy")
def _scan_hops(
    times: Array, places: Array, weights: Array, closing: float, periods: Array, phases: int,
    rounds: int,
) -> Array:  # fmt: skip
    """The hops of least cost; after robust rounds the cost is the median distance."""
    best = np.full(11, np.nan)
    least = np.inf
    rows, distances = np.empty((len(times), 3)), np.empty(len(times))
    own = np.empty(len(times))
    for period in periods:
        for step in range(phases):
            phase = period * step / phases
            for k in range(len(times)):
                t = times[k]
                rows[k, 0], rows[k, 1] = 1.0, t
                rows[k, 2] = (1.0 - closing * t) * abs(np.sin(np.pi * (t - phase) / period))
            copy_into(weights, own)
            cost = np.inf
            answer = np.empty((3, 3))
            for _ in range(rounds + 1):
                _linear(rows, places, own, answer)
                cost = 0.0
                for k in range(len(times)):
                    distances[k] = 0.0
                    for j in range(3):
                        fitted = 0.0
                        for i in range(3):
                            fitted += rows[k, i] * answer[i, j]
                        distances[k] += (places[k, j] - fitted) ** 2
                    cost += weights[k] * distances[k]
                if rounds > 0:
                    cost = quantile(distances, 0.5)
                    for k in range(len(times)):
                        own[k] = weights[k] / (1.0 + distances[k] / (_CUT_MEDIANS * cost)) ** 2
            if cost < least:
                least = cost
                for i in range(3):
                    copy_into(answer[i], best[3 * i :])
                best[9], best[10] = period, phase
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _linear(rows: Array, places: Array, weights: Array, out: Array) -> None:
    """Fill (3, 3), weighted least squares of places (N, 3) in basis functions (N, 3)."""
    matrix, right = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(len(rows)):
        for i in range(3):
            for j in range(3):
                matrix[i, j] += weights[k] * rows[k, i] * rows[k, j]
                right[j, i] += weights[k] * rows[k, i] * places[k, j]
    for i in range(3):
        matrix[i, i] *= 1.0 + 1e-9
    fits = cholesky(matrix, matrix)
    for j in range(3):
        substitute(matrix, right[j], right[j])
        for i in range(3):
            out[i, j] = right[j, i] if fits else np.nan
