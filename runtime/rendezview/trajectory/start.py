"""Starting values of a fit: closed-form least squares."""

from __future__ import annotations

import numpy as np

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
_HELD = 1e-9  # of the diagonal: hops like a line. Source: by construction, rounding


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
    return _scan_hops(times_s, places_m, weights, closing, periods, _PHASES, rounds)


def _scan_hops(
    times: Array, places: Array, weights: Array, closing: float, periods: Array, phases: int,
    rounds: int,
) -> Array | None:  # fmt: skip
    """The hops of least cost; after robust rounds the cost is the median distance."""
    period = np.repeat(periods, phases)
    phase = period * np.tile(np.arange(phases), len(periods)) / phases
    high = np.abs(np.sin(np.pi * (times - phase[:, None]) / period[:, None]))
    rows = np.empty((len(period), 3, len(times)))
    rows[:, 0], rows[:, 1], rows[:, 2] = 1.0, times, (1.0 - closing * times) * high
    own = np.broadcast_to(weights, high.shape)
    for _ in range(rounds + 1):
        weighted = rows * own[:, None]
        matrix = weighted @ rows.transpose(0, 2, 1)
        matrix[:, range(3), range(3)] *= 1.0 + _HELD
        try:
            answers = np.linalg.solve(matrix, weighted @ places)
        except np.linalg.LinAlgError:
            return None
        distances = ((rows.transpose(0, 2, 1) @ answers - places) ** 2).sum(axis=2)
        costs = distances @ weights
        if rounds > 0:
            costs = np.median(distances, axis=1)
            own = weights / (1.0 + distances / (_CUT_MEDIANS * costs[:, None])) ** 2
    best = int(np.argmin(np.where(np.isnan(costs), np.inf, costs)))
    found = np.append(answers[best], [period[best], phase[best]])
    return found if np.isfinite(found).all() else None
