"""Where exactly the edges of ellipses lie: blurred steps along all of them, with covariances."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.ring.ellipse import axes_of_shape
from rendezview.ring.steps import step_support
from rendezview.ring.support import (
    ANGLE,
    ARC,
    COLUMNS,
    CONTRAST,
    OFFSET,
    WEIGHT,
    distance,
    update_shape,
)
from rendezview.ring.verify import one_sense, twins

_MOST_SAMPLES = 640  # along one ellipse


@njit(cache=True, nogil=True)
def fit_steps(  # type: ignore[no-untyped-def]
    image, lens, shapes, spacing, noise, filters, basis, blur, least_arc, floor
):
    """Blurred-step fits: shapes (M, 5), covariances (M, 5, 5), (M, 3) arc, contrast, rms."""
    total = shapes.shape[0]
    current = shapes.copy()
    fitted = np.empty((total, 5))
    covariances = np.empty((total, 5, 5))
    facts = np.empty((total, 3))
    samples = np.zeros((_MOST_SAMPLES, COLUMNS))
    others = np.empty((total, 5))
    normal = np.empty((5, 5))
    count = 0
    for k in range(total):
        shape = current[k].copy()
        beside = 0
        for j in range(total):
            if j != k and not twins(current[j], shape, 2.5) and _meet(current[j], shape, 14.0):
                others[beside] = current[j]
                beside += 1
        row = axes_of_shape(shape)
        around = np.pi * (3.0 * (row[2] + row[3])
                          - np.sqrt((3.0 * row[2] + row[3]) * (row[2] + 3.0 * row[3])))  # fmt: skip
        step_px = max(spacing, around / (0.8 * _MOST_SAMPLES))
        good = True
        n = 0
        sense = 0.0
        for step in range(4):
            # The first look is a sparse one: it brings the ellipse onto the edge.
            n = step_support(
                image, lens, shape, 4.0 * step_px if step == 0 else step_px, sense, noise,
                filters, basis, blur, others[:beside], samples,
            )  # fmt: skip
            if step == 0:
                one_sense(samples, n)
            scale = 2.0 if step == 0 else _scale(samples, n)
            moved = update_shape(samples, n, scale, shape, normal)
            if moved < 0.0 or _covered(samples, n, scale) < 0.5 * least_arc:
                good = False
                break
            if step > 0 and moved < 0.01:
                break
        if not good:
            continue
        twin = False
        for j in range(count):
            if twins(fitted[j], shape, 1.0):
                twin = True
        if twin:
            continue
        scale = _scale(samples, n)
        chi, used, contrast, weight, square = 0.0, 0, 0.0, 0.0, 0.0
        for i in range(n):
            if samples[i, WEIGHT] > 0.0:
                if abs(samples[i, OFFSET]) > scale:
                    samples[i, WEIGHT] = 0.0
                    continue
                w = samples[i, WEIGHT]
                chi += w * samples[i, OFFSET] ** 2
                square += samples[i, OFFSET] ** 2
                used += 1
                weight += 1.0
                contrast += samples[i, CONTRAST]
        arc = _covered(samples, n, scale)
        if used < 20 or arc < 0.8 * least_arc:
            continue
        update = shape.copy()
        if update_shape(samples, n, 3.0 * scale, update, normal) < 0.0:
            continue
        trace = np.trace(normal)
        for j in range(5):
            normal[j, j] += 1e-12 * trace
        spread = max(chi / max(used - 5, 1), 0.5) * _correlation_factor(samples, n)
        spread = max(spread, _waviness_factor(samples, n))
        fitted[count] = update
        covariances[count] = np.linalg.inv(normal) * spread
        for j in range(5):
            covariances[count, j, j] += floor * floor
        facts[count, 0], facts[count, 1] = arc, contrast / weight
        facts[count, 2] = np.sqrt(square / used)
        current[k] = update
        count += 1
    return fitted[:count], covariances[:count], facts[:count]


@njit(cache=True, nogil=True)
def _meet(a, b, near):  # type: ignore[no-untyped-def]
    """Whether ellipse a comes within ``near`` px of some of 24 points of ellipse b."""
    for k in range(24):
        u0, u1 = np.cos(np.pi * k / 12.0), np.sin(np.pi * k / 12.0)
        x, y = b[0] + b[2] * u0 + b[3] * u1, b[1] + b[3] * u0 + b[4] * u1
        if abs(distance(a, x, y)) < near:
            return True
    return False


@njit(cache=True, nogil=True)
def _scale(samples, n):  # type: ignore[no-untyped-def]
    """Where offsets stop counting, px: five σ of them, from their median size."""
    size = np.empty(n)
    count = 0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0:
            size[count] = abs(samples[i, OFFSET])
            count += 1
    if count == 0:
        return 1.0
    return min(max(5.0 * 1.483 * float(np.median(size[:count])), 0.15), 2.0)


@njit(cache=True, nogil=True)
def _covered(samples, n, scale):  # type: ignore[no-untyped-def]
    """Angle of the circle that samples within ``scale`` px bear out, rad."""
    total = 0.0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0 and abs(samples[i, OFFSET]) < scale:
            total += samples[i, ARC]
    return total


@njit(cache=True, nogil=True)
def _waviness_factor(samples, count):  # type: ignore[no-untyped-def]
    """How much more the means of 36 stretches scatter than independent samples' would, ≥ 1.

    Facets of a CAD ring, shadows, or an edge that is none show here: their errors go together over
    long stretches.
    """
    sums, weights = np.zeros(36), np.zeros(36)
    for i in range(count):
        w = samples[i, WEIGHT]
        if w > 0.0:
            k = min(int(samples[i, ANGLE] * (36.0 / (2.0 * np.pi))), 35)
            sums[k] += w * samples[i, OFFSET]
            weights[k] += w
    total, used = 0.0, 0
    for k in range(36):
        if weights[k] > 0.0:
            total += sums[k] * sums[k] / weights[k]
            used += 1
    return max(total / max(used - 5, 2), 1.0)


@njit(cache=True, nogil=True)
def _correlation_factor(samples, count):  # type: ignore[no-untyped-def]
    """Sum of the correlations between a sample's error and its neighbours' (1 for none), ≥ 1."""
    power, pairs = 0.0, 0
    for i in range(count):
        if samples[i, WEIGHT] > 0.0:
            power += samples[i, OFFSET] ** 2 * samples[i, WEIGHT]
            pairs += 1
    if pairs < 12 or power <= 0.0:
        return 2.0
    factor = 1.0
    for lag in range(1, 6):
        total, n = 0.0, 0
        for i in range(count):
            j = i + lag
            if j >= count:
                j -= count
            if samples[i, WEIGHT] > 0.0 and samples[j, WEIGHT] > 0.0:
                total += (
                    samples[i, OFFSET] * samples[j, OFFSET]
                    * np.sqrt(samples[i, WEIGHT] * samples[j, WEIGHT])
                )  # fmt: skip
                n += 1
        if n < 12:
            break
        factor += 2.0 * (total / n) / (power / pairs)
    return min(max(factor, 1.0), 6.0)
