"""Normal equations of parameters of unlike sizes, and the covariance where they end."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.trajectory.shapes import HOPS, SIZE, SPIRAL

_MOST_CORRELATED = 0.9  # Source: by construction, a bound only
# Of the trace, what keeps a matrix regular. Source: by construction, some steps of a double
_HELD = 1e-14


def typical_sizes(code: int, length_m: float, half_s: float) -> Array:
    """(P,) typical sizes: of parameters that move places by about ``length_m``."""
    length, speed = np.full(3, length_m), np.full(3, length_m / half_s)
    if code <= SPIRAL:
        whole = [1.0, 1.0, 1.0, length_m, 1.0 / half_s, length_m / half_s]
        return np.array(whole[: SIZE[code]])
    if code == HOPS:
        return np.concatenate([length, speed, length, [half_s, half_s]])
    return np.concatenate([length, speed, speed / half_s])[: SIZE[code]]


def inverse_of(matrix: Array, scales: Array) -> Array:
    """(P, P) inverse, worked out in units of ``scales``; what nothing is known of stays put."""
    values, vectors = np.linalg.eigh(matrix * scales[:, None] * scales[None, :])
    turned = scales[:, None] * vectors
    return np.asarray((turned / (np.maximum(values, 0.0) + _HELD * values.sum())) @ turned.T)


def held(matrix: Array, scales: Array) -> Array:
    """(P,) one σ of the misfit that holds each parameter where ``inverse_of`` knows nothing."""
    return np.asarray(np.sqrt(_HELD * np.sum(np.diag(matrix) * scales**2)) / scales)


def robust_root(
    inverse: Array, slopes: Array, weighted: Array, first: npt.NDArray[np.intp], times: Array,
    common: Array, held: Array,
) -> Array:  # fmt: skip
    """(P, P) L with L Lᵀ the covariance, so that rounding makes no variance negative.

    From the points' own misfits, summed over each frame before they are squared.

    Args:
        inverse: (P, P) of the normal equations.
        slopes: (N, K, P) of the misfits.
        weighted: (N, K) misfits times their robust weights.
        first: (F,) the first point of each frame.
        times: (N,) from the middle.
        common: (N,) weights of the points, times the share of their σ that all have in common, and
            half as much again that goes with time and its square: views alike err alike.
        held: (P,) one σ of the prior's misfits.
    """
    scores = np.add.reduceat(np.einsum("nkp,nk->np", slopes, weighted), first)
    frames, size = scores.shape
    # Misfits of neighbouring frames alike: fewer frames than it seems.
    means = np.add.reduceat(weighted, first)
    square = float(np.sum(means**2))
    alike = float(np.sum(means[1:] * means[:-1])) / square if square > 0.0 else 0.0
    alike = min(max(alike, 0.0), _MOST_CORRELATED)
    scores *= np.sqrt(frames / max(frames - size, 1) * (1.0 + alike) / (1.0 - alike))
    along = times / max(float(np.abs(times).max()), 1e-12)
    slow = np.stack([np.ones_like(along), along, 1.5 * along**2 - 0.5])
    shared = np.einsum("sn,nkp->skp", slow * common, slopes).reshape(-1, size)
    moved = np.vstack([scores, shared, np.diag(held)]) @ inverse.T
    return np.asarray(np.linalg.qr(moved, mode="r")).T
