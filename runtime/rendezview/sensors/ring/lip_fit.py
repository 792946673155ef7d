"""The two edges of a narrow lip, fitted as one: concentric ellipses of opposite contrast.

A ring's lip is often only a few pixels wide. Under the Sun its outer edge shows on one side of the
ring and its inner edge on the other. One ellipse through both is shifted, and tilted by ten degrees
where the ring is seen face-on. Here both edges are fitted together: centre and shape are common,
their ratio is free, and each edge has its own sense of contrast.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into
from rendezview.sensors.ring.samples import update_shape
from rendezview.sensors.ring.spread import (
    covariance_of,
    covered,
    scale_of,
    systematic_of,
    trim,
)
from rendezview.sensors.ring.steps import sample_steps

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

# rad of either sense, below which no second edge is looked for. Source: by hand; see ring-accuracy
LEAST_ARC = 0.5
_LEAST_GAP_PX = 0.2  # between the two. Source: by hand; see ring-accuracy
_SIGMAS = 3.0  # of the gap. Source: normal distribution, 0.3 %


@njit(cache=True, nogil=True, error_model="numpy")
def fit_lip(
    image: Grey, lens: Array, shape: Array, step_px: float, noise: float, filters: Array,
    basis: Array, blur: float, others: Array, samples: Array, used: int, edges: Array,
    covariances: Array, facts: Array,
) -> bool:  # fmt: skip
    """Split an ellipse fitted to two edges into both, the larger one first; false if there is one.

    Args:
        image, lens, step_px, noise, filters, basis, blur, others: as for `sample_steps`.
        shape: (5,) of the ellipse.
        samples: the first ``used`` are the ellipse's; twice as many as one ellipse needs fit in.
        edges, covariances, facts: (2, 5), (2, 5, 5) and (2, 4) out, as of `fit_steps`. Errors
            common to both edges are in both covariances.
    """
    pair, normal = np.zeros(6), np.empty((6, 6))
    copy_into(shape, pair)
    if update_shape(samples, used, 2.0, pair, normal) < 0.0:
        return False
    if abs(pair[5]) * 0.5 * (pair[2] + pair[4]) < _LEAST_GAP_PX:
        return False  # one edge whose surroundings change
    half = samples.shape[0] // 2
    first, second, scale = 0, 0, 0.0
    for _ in range(4):
        for k in range(2):
            _edge(pair, 1.0 - 2.0 * k, edges[k])
        first = sample_steps(
            image, lens, edges[0], step_px, 1.0, noise, filters, basis, blur, others,
            samples[:half],
        )  # fmt: skip
        second = sample_steps(
            image, lens, edges[1], step_px, -1.0, noise, filters, basis, blur, others,
            samples[first : first + half],
        )  # fmt: skip
        scale = scale_of(samples, first + second)
        moved = update_shape(samples, first + second, scale, pair, normal)
        if moved < 0.0:
            return False
        if moved < 0.02:
            break
    rising, falling = samples[:first], samples[first : first + second]
    arcs = sum(covered(rising, first, scale)), sum(covered(falling, second, scale))
    if min(arcs) < LEAST_ARC:
        return False
    found = trim(rising, first, scale), trim(falling, second, scale)
    spread = max(found[0][3], found[1][3])
    if update_shape(samples, first + second, 3.0 * scale, pair, normal) < 0.0:
        return False
    whole = np.empty((6, 6))
    if not covariance_of(normal, spread, whole):
        return False
    if not abs(pair[5]) > _SIGMAS * np.sqrt(whole[5, 5]):
        return False
    _separate(pair, whole, arcs, found, edges, covariances, facts)
    facts[:, 3] = max(systematic_of(rising, first), systematic_of(falling, second))
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _separate(
    pair: Array, whole: Array, arcs: tuple[float, float],
    found: tuple[tuple[int, float, float, float], tuple[int, float, float, float]], edges: Array,
    covariances: Array, facts: Array,
) -> None:  # fmt: skip
    """Shapes, covariances and facts of both edges, the larger one first, from those of the pair."""
    slope = np.zeros((5, 6))
    for k in range(2):
        sense = (1.0 if k == 0 else -1.0) * (1.0 if pair[5] > 0.0 else -1.0)
        _edge(pair, sense, edges[k])
        for j in range(5):
            slope[j, j] = 1.0 if j < 2 else 1.0 + 0.5 * sense * pair[5]
            slope[j, 5] = 0.0 if j < 2 else 0.5 * sense * pair[j]
        for i in range(5):
            for j in range(5):
                total = 0.0
                for a in range(6):
                    for b in range(6):
                        total += slope[i, a] * whole[a, b] * slope[j, b]
                covariances[k, i, j] = total
        own = 0 if sense > 0.0 else 1
        facts[k, 0], facts[k, 1], facts[k, 2] = arcs[own], found[own][1], found[own][2]


@njit(cache=True, nogil=True, error_model="numpy")
def _edge(pair: Array, sense: float, shape: Array) -> None:
    """Shape (5,) of the edge of a sense (±1)."""
    shape[0], shape[1] = pair[0], pair[1]
    for j in range(2, 5):
        shape[j] = (1.0 + 0.5 * sense * pair[5]) * pair[j]
