"""Fits ellipses to blurred steps along their edges, with covariances."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into
from rendezview.sensors.ring.conic import distance, semi_axes
from rendezview.sensors.ring.lip_fit import LEAST_ARC, fit_lip
from rendezview.sensors.ring.samples import COLUMNS, update_shape
from rendezview.sensors.ring.spread import (
    covariance_of,
    covered,
    scale_of,
    systematic_of,
    trim,
)
from rendezview.sensors.ring.steps import sample_steps
from rendezview.sensors.ring.verify import twins

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.int64]

_MOST_SAMPLES = 640  # along one ellipse. Source: by construction, a bound of memory


@njit(cache=True, nogil=True, error_model="numpy")
def fit_steps(
    image: Grey, lens: Array, shapes: Array, spacing: float, noise: float, filters: Array,
    basis: Array, blur: float, least_arc: float, floor: float,
) -> tuple[Array, Array, Array, Ints]:  # fmt: skip
    """Blurred-step fits of the edges that rough ellipses (K, 5) lie on, or the pairs of edges.

    Returns:
        Shapes (M, 5); covariances (M, 5, 5); (M, 4) arc (rad), contrast (grey), r.m.s. (px), common
        part (σ, px); (M,) number of the pair that an edge was fitted in, -1 for none.
    """
    total = shapes.shape[0]
    current = shapes.copy()
    fitted = np.empty((2 * total, 5))
    covariances = np.empty((2 * total, 5, 5))
    facts = np.empty((2 * total, 4))
    pairs = np.empty(2 * total, dtype=np.int64)
    samples = np.zeros((2 * _MOST_SAMPLES, COLUMNS))
    others = np.empty((total, 5))
    both, both_covariances, both_facts = np.empty((2, 5)), np.empty((2, 5, 5)), np.empty((2, 4))
    count, pair = int(np.int64(0)), 0  # as a literal, numba would compile a copy for it
    for k in range(total):
        shape = current[k].copy()
        beside = _neighbours(current, k, others)
        step_px = _step_px(shape, spacing)
        used, scale = _settle(
            image, lens, shape, step_px, noise, filters, basis, blur, others[:beside],
            samples[:_MOST_SAMPLES], 0.5 * least_arc,
        )  # fmt: skip
        if used == 0:
            continue
        two = False
        if min(covered(samples, used, scale)) > LEAST_ARC:
            two = fit_lip(
                image, lens, shape, step_px, noise, filters, basis, blur, others[:beside],
                samples, used, both, both_covariances, both_facts,
            )  # fmt: skip
        if two:
            for e in range(2):
                if not _known(fitted, count, both[e]):
                    copy_into(both[e], fitted[count])
                    copy_matrix_into(both_covariances[e], covariances[count])
                    copy_into(both_facts[e], facts[count])
                    pairs[count] = pair
                    count += 1
            pair += 1
            copy_into(both[0], current[k])
        elif not _known(fitted, count, shape) and _fit_single(
            samples, used, scale, shape, covariances[count], facts[count]
        ):
            copy_into(shape, fitted[count])
            pairs[count] = -1
            count += 1
            copy_into(shape, current[k])
    for e in range(count):
        for j in range(5):
            covariances[e, j, j] += floor * floor
    return fitted[:count], covariances[:count], facts[:count], pairs[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _neighbours(shapes: Array, k: int, others: Array) -> int:
    """Fill ``others`` with the ellipses that come near ellipse k and are not the same; how many."""
    count = 0
    for j in range(shapes.shape[0]):
        if j == k or twins(shapes[j], shapes[k], 2.5) or not _meet(shapes[j], shapes[k], 14.0):
            continue
        copy_into(shapes[j], others[count])
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(a: Array, b: Array, near: float) -> bool:
    """Whether ellipse a comes within ``near`` px of some of 24 points of ellipse b."""
    for k in range(24):
        u0, u1 = np.cos(np.pi * k / 12.0), np.sin(np.pi * k / 12.0)
        x, y = b[0] + b[2] * u0 + b[3] * u1, b[1] + b[3] * u0 + b[4] * u1
        if abs(distance(a, x, y)) < near:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _step_px(shape: Array, spacing: float) -> float:
    """Between samples: as wanted, or as many samples as there is room for."""
    a, b = semi_axes(shape)
    around = np.pi * (3.0 * (a + b) - np.sqrt((3.0 * a + b) * (a + 3.0 * b)))
    return float(max(spacing, around / (0.8 * _MOST_SAMPLES)))


@njit(cache=True, nogil=True, error_model="numpy")
def _settle(
    image: Grey, lens: Array, shape: Array, step_px: float, noise: float, filters: Array,
    basis: Array, blur: float, others: Array, samples: Array, least_arc: float,
) -> tuple[int, float]:  # fmt: skip
    """Bring a shape onto its edge; number of samples, 0 where there is none, and their scale."""
    n = 0
    for step in range(4):
        # The first pass is a sparse one: it brings the ellipse onto the edge.
        n = sample_steps(
            image, lens, shape, 4.0 * step_px if step == 0 else step_px, 0.0, noise,
            filters, basis, blur, others, samples,
        )  # fmt: skip
        scale = 2.0 if step == 0 else scale_of(samples, n)
        moved = update_shape(samples, n, scale, shape, np.empty((5, 5)))
        if moved < 0.0 or sum(covered(samples, n, scale)) < least_arc:
            return 0, 0.0
        if step > 0 and moved < 0.01:
            break
    return n, scale_of(samples, n)


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_single(
    samples: Array, n: int, scale: float, shape: Array, covariance: Array, facts: Array
) -> bool:  # fmt: skip
    """The last step of one edge, its covariance and facts; whether enough samples confirm it."""
    used, contrast, rms, spread = trim(samples, n, scale)
    arc = sum(covered(samples, n, scale))
    normal = np.empty((5, 5))
    if used < 20 or update_shape(samples, n, 3.0 * scale, shape, normal) < 0.0:
        return False
    if not covariance_of(normal, spread, covariance):
        return False
    facts[0], facts[1], facts[2], facts[3] = arc, contrast, rms, systematic_of(samples, n)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _known(fitted: Array, count: int, shape: Array) -> bool:
    """Whether an ellipse is there already."""
    known = False
    for j in range(count):
        known |= twins(fitted[j], shape, 1.0)
    return known
