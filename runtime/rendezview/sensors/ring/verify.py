"""Confirms rough ellipses by the gradients of the picture, and moves them onto their edges.

Enough of a candidate's circle must be edge. A candidate on the edges of better ellipses is dropped.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, descending, largest_at
from rendezview.sensors.ring.conic import distance, within
from rendezview.sensors.ring.samples import (
    COLUMNS,
    PX,
    PY,
    WEIGHT,
    sample_gradients,
    update_shape,
)

Array = npt.NDArray[np.float64]
Gradient = npt.NDArray[np.int16]  # Sobel's sum: 8 × grey levels a pixel

_SUPPORT_SAMPLES = 120  # about an ellipse. Source: by construction, 3° apart


@njit(cache=True, nogil=True, error_model="numpy")
def verify(
    dx: Gradient, dy: Gradient, low: float, lens: Array, rough: Array, least_arc: float,
    limits: Array, most: int,
) -> Array:  # fmt: skip
    """The rough ellipses (K, 5) that the gradients confirm, moved onto them: shapes (M, 5)."""
    kept = np.empty((most, 5))
    value = np.empty(most)
    count = 0
    samples = np.zeros((_SUPPORT_SAMPLES, COLUMNS))
    normal = np.empty((5, 5))
    n = len(samples)
    for k in range(rough.shape[0]):
        shape = rough[k].copy()
        good = True
        twin = False
        for step in range(4):
            band = max(4.0 - step, 2.0)
            n = len(samples) // 2
            sample_gradients(dx, dy, low, lens, shape, n, band, samples)
            moved = update_shape(samples, n, band + 1.0, shape, normal)
            if moved < 0.0 or not within(shape, limits):
                good = False
                break
            for j in range(count):
                if twins(kept[j], shape, 1.5):
                    twin = True
            if twin or moved < 0.1:
                break
        if not good or twin:
            continue
        n = len(samples)
        share = sample_gradients(dx, dy, low, lens, shape, n, 1.5, samples) / n
        if share * 2.0 * np.pi < least_arc:
            continue
        at = count
        if count == most:
            at = largest_at(-value)
            if value[at] >= share:
                continue
        else:
            count += 1
        copy_into(shape, kept[at])
        value[at] = share
    return _exclusive(dx, dy, low, lens, kept[descending(value[:count])], least_arc)


@njit(cache=True, nogil=True, error_model="numpy")
def _exclusive(
    dx: Gradient, dy: Gradient, low: float, lens: Array, shapes: Array, least_arc: float
) -> Array:
    """Shapes (M, 5), best first, less those that live on the edges of better ones."""
    samples = np.zeros((_SUPPORT_SAMPLES, COLUMNS))
    n = len(samples)
    kept = np.empty_like(shapes)
    count = 0
    for k in range(shapes.shape[0]):
        sample_gradients(dx, dy, low, lens, shapes[k], n, 1.5, samples)
        own = 0
        for i in range(n):
            if samples[i, WEIGHT] > 0.0:
                free = True
                for j in range(count):
                    if abs(distance(kept[j], samples[i, PX], samples[i, PY])) < 2.0:
                        free = False
                        break
                own += free
        if own * 2.0 * np.pi / n >= 0.8 * least_arc:
            copy_into(shapes[k], kept[count])
            count += 1
    return kept[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def twins(a: Array, b: Array, near: float) -> bool:
    """Whether two shapes are one ellipse, to ``near`` px."""
    same = True
    for k in range(len(a)):
        same &= abs(a[k] - b[k]) <= near
    return same
