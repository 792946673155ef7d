"""The loops of the filter, compiled: a measurement beside all models, and what it teaches.

All models share one nominal state; each has its own deviation x (M, n), covariance P (M, n, n) and
probability (M,). The state's layout is in `state`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import copy_matrix_into, square_root
from rendezview.geometry import so3
from rendezview.geometry.pose import Array

# Of a model, so that it can return. Source: plain situations; at 1e-5 outliers cost 1.4 × the place
_LEAST_PROBABILITY = 1e-4


@njit(cache=True, nogil=True, error_model="numpy")
def with_bias(
    motion: Array, whole: Array, shares: Array, start: int, count: int
) -> tuple[bool, Array, Array, Array, Array]:
    """A measurement's slope by every state and its noise, split from its covariance.

    Args:
        motion: (k, c) slope by the first c states.
        whole: (k, k) covariance that the sensor reports, A Aᵀ.
        shares: (k,) white share of it, by column of A; what is left to 1 is bias.
        start, count: index of the bias, number of states.

    Returns:
        Whether the covariance is positive; (k, n) slope; (k, k) white covariance; (k, k) A;
        (k,) σ.
    """
    k = len(whole)
    root = square_root(whole)
    design, noise, sigmas = np.zeros((k, count)), np.zeros((k, k)), np.empty(k)
    fits = True
    for i in range(k):
        fits = fits and root[i, i] > 0.0
        sigmas[i] = math.sqrt(max(whole[i, i], 0.0))
        for j in range(motion.shape[1]):
            design[i, j] = motion[i, j]
        for j in range(i + 1):
            design[i, start + j] = root[i, j] * math.sqrt(max(1.0 - shares[j], 0.0))
        for j in range(k):
            for c in range(min(i, j) + 1):
                noise[i, j] += root[i, c] * shares[c] * root[j, c]
    return fits, design, noise, root, sigmas


@njit(cache=True, nogil=True, error_model="numpy")
def renewed(deviations: Array, covariances: Array, start: int, kept: Array) -> tuple[Array, Array]:
    """Deviations and covariances after some biases, of variance 1, lost memory in part.

    Args:
        start: index of the first of k biases.
        kept: (k,) correlation of each bias with what it was.
    """
    x, p = deviations.copy(), covariances.copy()
    for m in range(len(x)):
        for i in range(len(kept)):
            b = start + i
            x[m, b] *= kept[i]
            for j in range(x.shape[1]):
                p[m, b, j] *= kept[i]
                p[m, j, b] *= kept[i]
            p[m, b, b] += 1.0 - kept[i] ** 2
    return x, p


@njit(cache=True, nogil=True, error_model="numpy")
def log_mean(weights: Array, logs: Array) -> float:
    """Logarithm of the weighted mean of exp(``logs``), both (M,)."""
    best, total = -np.inf, 0.0
    for m in range(len(logs)):
        best = max(best, logs[m])
    for m in range(len(logs)):
        total += weights[m] * math.exp(logs[m] - best)
    return float(best + math.log(max(total, 1e-300)))


@njit(cache=True, nogil=True, error_model="numpy")
def compared(
    deviations: Array, covariances: Array, weights: Array, design: Array, noise: Array,
    residual: Array,
) -> tuple[bool, float, float, float, Array, Array, Array, Array, Array]:  # fmt: skip
    """A residual beside every model: its innovation in units of S = H P Hᵀ + R = L Lᵀ.

    Args:
        design: (k, n) H, slope of the measurement by every state.
        noise: (k, k) R, white.
        residual: (k,) measured − expected at the nominal state.

    Returns:
        Whether every S is positive; log-likelihood over all models; the mean of its largest value,
        at no deviation; mean NIS; (k,) mean innovation; (M,) log-likelihoods; (M, n, k) P Hᵀ;
        (M, k, k) L; (M, k) L⁻¹ innovation.
    """
    count, n = deviations.shape
    k = len(residual)
    across, lowers = np.zeros((count, n, k)), np.zeros((count, k, k))
    whites, logs, mean = np.empty((count, k)), np.empty(count), np.zeros(k)
    spread = np.empty((k, k))
    fits, peak, squared = True, 0.0, 0.0
    for m in range(count):
        for r in range(k):
            off = residual[r]
            for j in range(n):
                h = design[r, j]
                if h != 0.0:
                    off -= h * deviations[m, j]
                    for i in range(n):
                        across[m, i, r] += covariances[m, j, i] * h
            whites[m, r] = off
            mean[r] += weights[m] * off
        for r in range(k):
            for c in range(r + 1):
                s = 0.5 * (noise[r, c] + noise[c, r])
                for j in range(n):
                    if design[r, j] != 0.0:
                        s += design[r, j] * across[m, j, c]
                spread[r, c] = spread[c, r] = s
        lower = square_root(spread)
        nis, volume = 0.0, 0.0
        for r in range(k):
            if not lower[r, r] > 0.0:
                fits = False
                lower[r, r] = np.inf
            for c in range(r):
                whites[m, r] -= lower[r, c] * whites[m, c]
            whites[m, r] /= lower[r, r]
            nis += whites[m, r] ** 2
            volume += 2.0 * math.log(lower[r, r])
        copy_matrix_into(lower, lowers[m])
        height = -0.5 * (volume + k * math.log(2.0 * math.pi))
        logs[m] = height - 0.5 * nis
        peak += weights[m] * height
        squared += weights[m] * nis
    return (
        fits, log_mean(weights, logs), peak, squared, mean, logs, across, lowers,
        whites,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def corrected(
    rotation: Array, place: Array, rate: Array, velocity: Array, deviations: Array,
    covariances: Array, weights: Array, logs: Array, across: Array, lowers: Array, whites: Array,
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Rotation, place, rate, velocity, deviations, covariances, weights after a measurement.

    The last four arguments are those that `compared` returns. The mean deviation goes into the
    nominal state; jitter and acceleration stay deviations, since each model has its own.
    """
    count, n, k = across.shape
    x, p, after = deviations.copy(), np.empty((count, n, n)), np.empty(count)
    best, total = -np.inf, 0.0
    for m in range(count):
        best = max(best, logs[m])
    for m in range(count):
        after[m] = max(weights[m] * math.exp(logs[m] - best), 1e-300)
        total += after[m]
    rest = 0.0
    for m in range(count):
        after[m] = max(after[m] / total, _LEAST_PROBABILITY)
        rest += after[m]
    gains = np.empty((n, k))
    mean = np.zeros(12)
    for m in range(count):
        after[m] /= rest
        # P Hᵀ L⁻ᵀ, so that P falls by its square and stays symmetric.
        for i in range(n):
            for r in range(k):
                s = across[m, i, r]
                for c in range(r):
                    s -= lowers[m, r, c] * gains[i, c]
                gains[i, r] = s / lowers[m, r, r]
                x[m, i] += gains[i, r] * whites[m, r]
        for i in range(n):
            for j in range(i + 1):
                s = 0.5 * (covariances[m, i, j] + covariances[m, j, i])
                for r in range(k):
                    s -= gains[i, r] * gains[j, r]
                p[m, i, j] = s
                p[m, j, i] = s
        for i in range(12):
            mean[i] += after[m] * x[m, i]
    for m in range(count):
        for i in range(12):
            x[m, i] -= mean[i]
    turned = np.empty((3, 3))
    so3.perturb_into(mean[:3], rotation, turned)
    so3.orthonormalise(turned)
    return turned, place + mean[3:6], rate + mean[6:9], velocity + mean[9:12], x, p, after


@njit(cache=True, nogil=True, error_model="numpy")
def white_share(shares: Array, root: Array, weights: Array, lowers: Array, whites: Array) -> Array:
    """(k,) how much larger the white share of each component seems than it was taken.

    One step of expectation and maximisation: w² ((Aᵀ S⁻¹ y)² − diag Aᵀ S⁻¹ A), where A Aᵀ is the
    sensor's covariance; the mean of the first three components, and of the others.

    Args:
        shares: (k,) as taken.
        root: (k, k) A.
        lowers, whites: (M, k, k) and (M, k) of `compared`.
    """
    count, k = whites.shape
    out = np.zeros(k)
    column = np.empty(k)
    for m in range(count):
        for c in range(k):
            along, size = 0.0, 0.0
            for r in range(k):
                s = root[r, c]
                for q in range(r):
                    s -= lowers[m, r, q] * column[q]
                column[r] = s / lowers[m, r, r]
                along += column[r] * whites[m, r]
                size += column[r] ** 2
            # An outlier within the gate must not teach more than five σ.
            seen = min(along**2, 25.0 * size)
            out[c] += weights[m] * (seen - size) * shares[c] ** 2
    for first, last in ((0, min(k, 3)), (3, k)):
        mean = 0.0
        for c in range(first, last):
            mean += out[c] / (last - first)
        for c in range(first, last):
            out[c] = mean
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def jitter_step(
    design: Array, weights: Array, lowers: Array, whites: Array, gained: float, kinds: int
) -> float:
    """Fisher's scoring step of the jitter's variance, rad².

    Args:
        design: (k, n) slope of the measurement by every state, the attitude first.
        gained: share of the jitter's variance that is new since the last pose.
        kinds: number of jitters; the first of them is learnt, by its models unless they are
            unlikely.
    """
    count, k = whites.shape
    slope, curvature, own = 0.0, 0.0, 0.0
    for m in range(0, count, kinds):
        own += weights[m]
    stride = kinds if own >= 0.2 else 1
    total = own if own >= 0.2 else 1.0
    column = np.empty((k, 3))
    for m in range(0, count, stride):
        weight = weights[m] / total
        for c in range(3):
            along, size = 0.0, 0.0
            for r in range(k):
                s = design[r, c]
                for q in range(r):
                    s -= lowers[m, r, q] * column[q, c]
                column[r, c] = s / lowers[m, r, r]
                along += column[r, c] * whites[m, r]
                size += column[r, c] ** 2
            slope += weight * gained * (along**2 - size)
        for c in range(3):
            for d in range(3):
                dot = 0.0
                for r in range(k):
                    dot += column[r, c] * column[r, d]
                curvature += weight * (gained * dot) ** 2
    return slope / curvature if curvature > 0.0 else 0.0
