"""A measurement beside all models of the motion, and what it teaches; see `state`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rendezview.fusion.state import FilterState
from rendezview.geometry import so3
from rendezview.geometry.pose import Array

# Of a model, so that it can return. Source: plain situations; at 1e-5 outliers cost 1.4 × the place
_LEAST_PROBABILITY = 1e-4
_PIVOT = 1e-14  # of a variance: what is left is rounding. Source: about 50 times that of float64


def root_of(covariances: Array) -> Array | None:
    """(…, k, k) lower Cholesky factors of covariances; None where one is not positive."""
    try:
        roots = np.asarray(np.linalg.cholesky(covariances))
    except np.linalg.LinAlgError:
        return None
    pivots = np.diagonal(roots, axis1=-2, axis2=-1) ** 2
    return roots if (pivots > _PIVOT * np.diagonal(covariances, 0, -2, -1)).all() else None


def renewed(state: FilterState, start: int, kept: Array) -> FilterState:
    """The state after some biases, of variance 1, lost memory in part.

    Args:
        start: index of the first of k biases.
        kept: (k,) correlation of each bias with what it was.
    """
    entries = np.arange(start, start + len(kept))
    fade = np.ones(state.deviations.shape[1])
    fade[entries] = kept
    x, p = state.deviations * fade, state.covariances * fade[:, None] * fade
    p[:, entries, entries] += 1.0 - kept**2
    return state._replace(deviations=x, covariances=p)


class Comparison(NamedTuple):
    """A residual beside every model: its innovation in units of S = H P Hᵀ + R = L Lᵀ."""

    total: float  # log-likelihood over all models
    peak: float  # the mean of its largest value, at no deviation
    nis: float  # mean
    innovation: Array  # (k,) mean
    logs: Array  # (M,) log-likelihoods
    across: Array  # (M, n, k) P Hᵀ
    lowers: Array  # (M, k, k) L
    whites: Array  # (M, k) L⁻¹ innovation


def compared(state: FilterState, design: Array, noise: Array, residual: Array) -> Comparison | None:
    """A residual beside every model; None where an S is not positive.

    Args:
        design: (k, n) H, slope of the measurement by every state.
        noise: (k, k) R, white.
        residual: (k,) measured − expected at the nominal state.
    """
    weights = state.weights
    across = state.covariances @ design.T
    offs = residual - state.deviations @ design.T
    spreads = design @ across + noise
    lowers = root_of(0.5 * (spreads + spreads.transpose(0, 2, 1)))
    if lowers is None:
        return None
    whites: Array = np.asarray(np.linalg.solve(lowers, offs[:, :, None])[:, :, 0])
    volumes = np.log(np.diagonal(lowers, axis1=1, axis2=2)).sum(axis=1)
    heights = -volumes - 0.5 * len(residual) * math.log(2.0 * math.pi)
    squares = (whites**2).sum(axis=1)
    logs = heights - 0.5 * squares
    return Comparison(
        log_mean(weights, logs), float(weights @ heights), float(weights @ squares),
        weights @ offs, logs, across, lowers, whites,
    )  # fmt: skip


def log_mean(weights: Array, logs: Array) -> float:
    """Logarithm of the weighted mean of exp(``logs``), both (M,)."""
    best = float(logs.max())
    return best + math.log(max(float(weights @ np.exp(logs - best)), 1e-300))


def corrected(state: FilterState, comparison: Comparison) -> FilterState:
    """The state after a measurement.

    The mean deviation goes into the nominal state; jitter and acceleration stay deviations, since
    each model has its own.
    """
    logs, across, lowers, whites = comparison[4:]
    after = np.maximum(state.weights * np.exp(logs - logs.max()), 1e-300)
    after = np.maximum(after / after.sum(), _LEAST_PROBABILITY)
    after /= after.sum()
    # P Hᵀ L⁻ᵀ, so that P falls by its square and stays symmetric.
    gains = np.linalg.solve(lowers, across.transpose(0, 2, 1)).transpose(0, 2, 1)
    x = state.deviations + (gains @ whites[:, :, None])[:, :, 0]
    p = state.covariances - gains @ gains.transpose(0, 2, 1)
    p = 0.5 * (p + p.transpose(0, 2, 1))
    mean = after @ x[:, :12]
    x[:, :12] -= mean
    turned = so3.exp(mean[:3]) @ state.rotation
    so3.orthonormalise(turned)
    return state._replace(
        rotation=turned, place_m=state.place_m + mean[3:6], rate=state.rate + mean[6:9],
        velocity=state.velocity + mean[9:12], deviations=x, covariances=p, weights=after,
    )  # fmt: skip


def white_share(shares: Array, root: Array, weights: Array, comparison: Comparison) -> Array:
    """(k,) how much larger the white share of each component seems than it was taken.

    One step of expectation and maximisation: w² ((Aᵀ S⁻¹ y)² − diag Aᵀ S⁻¹ A), where A Aᵀ is the
    sensor's covariance; the mean of the first three components, and of the others.

    Args:
        shares: (k,) as taken.
        root: (k, k) A.
    """
    columns = np.linalg.solve(comparison.lowers, root)
    along = (comparison.whites[:, None, :] @ columns)[:, 0]
    out = np.asarray(shares**2 * (weights @ (along**2 - (columns**2).sum(axis=1))))
    for part in (out[:3], out[3:]):
        if len(part):
            part[:] = part.mean()
    return out


def jitter_step(
    design: Array, weights: Array, comparison: Comparison, gained: float, kinds: int
) -> float:
    """Fisher's scoring step of the jitter's variance, rad².

    Args:
        design: (k, n) slope of the measurement by every state, the attitude first.
        gained: share of the jitter's variance that is new since the last pose.
        kinds: number of jitters; the first of them is learnt, by its models unless they are
            unlikely.
    """
    own = np.where(np.arange(len(weights)) % kinds == 0, weights, 0.0)
    own = own if own.sum() >= 0.2 else weights
    own = own / own.sum()
    columns = np.linalg.solve(comparison.lowers, design[:, :3])
    along = (comparison.whites[:, None, :] @ columns)[:, 0]
    slope = gained * float(own @ (along**2 - (columns**2).sum(axis=1)).sum(axis=1))
    dots = columns.transpose(0, 2, 1) @ columns
    curvature = gained**2 * float(own @ (dots**2).sum(axis=(1, 2)))
    return slope / curvature if curvature > 0.0 else 0.0
