"""Normal equations of parameters of unlike sizes: metres, seconds and radians."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.trajectory.shapes import HOPS, SIZE, SPIRAL


def typical_sizes(code: int, length_m: float, half_s: float) -> Array:
    """(P,) typical sizes: of parameters that move places by about ``length_m``."""
    length, speed = np.full(3, length_m), np.full(3, length_m / half_s)
    if code <= SPIRAL:
        whole = [1.0, 1.0, 1.0, length_m, 1.0 / half_s, length_m / half_s]
        return np.array(whole[: SIZE[code]])
    if code == HOPS:
        return np.concatenate([length, speed, length, [half_s, half_s]])
    return np.concatenate([length, speed, speed / half_s])[: SIZE[code]]


def solved(matrix: Array, right: Array, scales: Array) -> Array:
    """matrix⁻¹ right, in units of ``scales``; what nothing is known of stays put."""
    scaled = matrix * scales[:, None] * scales[None, :]
    least = 1e-14 * np.trace(scaled)
    return np.asarray(
        scales * np.linalg.solve(scaled + least * np.eye(len(scales)), scales * right)
    )


def inverse_of(matrix: Array, scales: Array) -> Array:
    """(P, P) of the same."""
    scaled = matrix * scales[:, None] * scales[None, :]
    least = 1e-14 * np.trace(scaled)
    inverse = np.linalg.inv(scaled + least * np.eye(len(scales)))
    return np.asarray(inverse * scales[:, None] * scales[None, :])


def sigmas_of(matrix: Array, scales: Array) -> Array:
    """(P,) one σ of each parameter, of independent points; no longer than a tenth of its scale."""
    return np.minimum(np.sqrt(np.maximum(np.diag(inverse_of(matrix, scales)), 1e-30)), 0.1 * scales)
