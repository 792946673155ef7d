"""Scatter of the samples of an ellipse's edge, and the covariance of a fit that follows from it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import invert, quantile
from rendezview.sensors.ring.samples import ARC, CONTRAST, OFFSET, WEIGHT

Array = npt.NDArray[np.float64]

_SINGULAR = 1e-12  # of the trace, added to the diagonal. Source: by construction, rounding


@njit(cache=True, nogil=True, error_model="numpy")
def scale_of(samples: Array, n: int) -> float:
    """Where offsets stop counting, px: five σ of them, from their median size."""
    size = np.empty(n)
    count = 0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0:
            size[count] = abs(samples[i, OFFSET])
            count += 1
    if count == 0:
        return 1.0
    return min(max(5.0 * 1.483 * quantile(size[:count], 0.5), 0.15), 2.0)


@njit(cache=True, nogil=True, error_model="numpy")
def covered(samples: Array, n: int, scale: float) -> tuple[float, float]:
    """Angles of the circle that samples within ``scale`` px confirm, rad.

    By edges that get brighter, and darker, outwards.
    """
    brighter, darker = 0.0, 0.0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0 and abs(samples[i, OFFSET]) < scale:
            if samples[i, CONTRAST] > 0.0:
                brighter += samples[i, ARC]
            else:
                darker += samples[i, ARC]
    return brighter, darker


@njit(cache=True, nogil=True, error_model="numpy")
def trim(samples: Array, n: int, scale: float) -> tuple[int, float, float, float]:
    """Leave out samples beyond ``scale`` px.

    Returns number, mean contrast, r.m.s. (px) and the factor on the covariance by their weights
    that follows from their scatter, at least 1.
    """
    used, contrast, square, chi = 0, 0.0, 0.0, 0.0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0:
            if abs(samples[i, OFFSET]) > scale:
                samples[i, WEIGHT] = 0.0
                continue
            square += samples[i, OFFSET] ** 2
            chi += samples[i, WEIGHT] * samples[i, OFFSET] ** 2
            used += 1
            contrast += samples[i, CONTRAST]
    if used == 0:
        return 0, 0.0, 0.0, 1.0
    return used, contrast / used, np.sqrt(square / used), max(chi / max(used - 5, 1), 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def covariance_of(normal: Array, spread: float, covariance: Array) -> bool:
    """Fill ``covariance`` (N, N) from normal equations, times ``spread``; False: not determined."""
    count = normal.shape[0]
    trace = 0.0
    for j in range(count):
        trace += normal[j, j]
    for j in range(count):
        normal[j, j] += _SINGULAR * trace
    if not invert(normal, np.empty((count, count)), covariance):
        return False
    covariance *= spread
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def systematic_of(samples: Array, n: int) -> float:
    """σ of the part of the offsets that neighbours have in common, px.

    The offsets left by a fit are noise where neighbours differ, and something else where they go
    together: the rear edge of a lip, a shadow, a facet.
    """
    square, jumps, used, pairs = 0.0, 0.0, 0, 0
    for i in range(n):
        if samples[i, WEIGHT] <= 0.0:
            continue
        square += samples[i, OFFSET] ** 2
        used += 1
        j = (i + 1) % n
        if samples[j, WEIGHT] > 0.0:
            jumps += 0.5 * (samples[i, OFFSET] - samples[j, OFFSET]) ** 2
            pairs += 1
    if used == 0 or pairs == 0:
        return 0.0
    return float(np.sqrt(max(square / used - jumps / pairs, 0.0)))
