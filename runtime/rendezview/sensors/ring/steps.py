"""Where exactly an ellipse's edge lies: a blurred step in the grey picture along its normals.

What the answer's accuracy comes from. Other edges that are near are part of the model where they
are known, and kept out of it by narrower windows where they are not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.special import ndtr

from rendezview.geometry.normal_table import normal_cdf
from rendezview.sensors.ring.support import (
    ARC,
    CONTRAST,
    OFFSET,
    WEIGHT,
    begin_sample,
    bend,
    distance,
)

Array = npt.NDArray[np.float64]

REACH = 3  # px to either side of the step fit
TAPS = 2 * REACH + 1
LEAST_GAP = 2.2  # px between two edges that can still be told apart
# Where the whole profile is no step, its near side may be: px from the edge, first and last.
WINDOWS = ((-REACH, REACH), (-REACH, 1), (-1, REACH), (-2, 1), (-1, 2))
_NO = 1e9


def step_basis(blur_px: float) -> Array:
    """(3, TAPS) columns of the model ``b + c Φ((d - δ)/σ)`` in b, c and c δ, at δ = 0."""
    d = np.arange(-REACH, REACH + 1) / blur_px
    return np.vstack(
        [np.ones(TAPS), ndtr(d), -np.exp(-0.5 * d * d) / (np.sqrt(2.0 * np.pi) * blur_px)]
    )


def step_filters(blur_px: float) -> Array:
    """(len(WINDOWS), 3, TAPS) that give b, c and c δ by least squares on each of `WINDOWS`."""
    basis = step_basis(blur_px)
    filters = np.zeros((len(WINDOWS), 3, TAPS))
    for window, (first, last) in zip(filters, WINDOWS, strict=True):
        taps = slice(first + REACH, last + REACH + 1)
        window[:, taps] = np.linalg.pinv(basis[:, taps].T)
    return filters


@njit(cache=True, nogil=True)
def _crowded(profile, inner, outer, blur_px, solved):  # type: ignore[no-untyped-def]
    """Fit a profile by the step at 0 together with those of the edges at ``inner`` and ``outer``.

    ``solved`` gets level, contrast, contrast × place, and the contrasts of the outer and the inner
    edge. Returns the variance of the third for unit noise, negative where there is no solution.
    """
    system = np.zeros((5, 7))  # normal equations, right side, unit vector of the third
    row = np.empty(5)
    for k in range(TAPS):
        d = float(k - REACH)
        z = d / blur_px
        row[0], row[1] = 1.0, normal_cdf(z)
        row[2] = -np.exp(-0.5 * z * z) / (2.5066282746310002 * blur_px)
        row[3] = normal_cdf((d - outer) / blur_px)
        row[4] = normal_cdf((d - inner) / blur_px) - 1.0  # 0 where the edge is out of reach
        for i in range(5):
            system[i, 5] += row[i] * profile[k]
            for j in range(5):
                system[i, j] += row[i] * row[j]
    system[2, 6] = 1.0
    for i in range(5):
        system[i, i] += 1e-4 if i < 3 else 1e-2  # an edge out of reach has no contrast
    for i in range(5):
        if not system[i, i] > 1e-9:
            return -1.0
        for j in range(5):
            if j == i:
                continue
            share = system[j, i] / system[i, i]
            for k in range(i, 7):
                system[j, k] -= share * system[i, k]
    for i in range(5):
        solved[i] = system[i, 5] / system[i, i]
    solved[0] -= solved[4]  # the inner step was written from its far side
    return system[2, 6] / system[2, 2]


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _step(profile, window):  # type: ignore[no-untyped-def]
    """Level, contrast and contrast × place of a profile by a window of `step_filters`."""
    level, contrast, shifted = 0.0, 0.0, 0.0
    for k in range(TAPS):
        level += window[0, k] * profile[k]
        contrast += window[1, k] * profile[k]
        shifted += window[2, k] * profile[k]
    return level, contrast, shifted


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _allowed(freedom, noise, contrast, place):  # type: ignore[no-untyped-def]
    """Squares that a step may leave: noise, another blur, its bend where it is far."""
    bend_grey = abs(contrast) * (0.02 + 0.2 * place * place)
    return 1.5 * freedom * (noise * noise + 0.1) + bend_grey * bend_grey


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def step_support(  # type: ignore[no-untyped-def]
    image, lens, shape, spacing_px, sense, noise, filters, basis, blur_px, others, samples,
):  # fmt: skip
    """Blurred steps along the normals of an ellipse; returns the number of samples filled.

    Args:
        image: (H, W) uint8.
        spacing_px: between samples along the ellipse.
        sense: 1 where the edge gets brighter outwards, -1 where darker; 0 takes both.
        noise: σ of a pixel, grey.
        filters, basis: of `step_filters` and `step_basis`; ``blur_px`` their σ.
        others: (K, 5) shapes of other edges: their steps are part of the fit where they are near,
            and where they are nearer than LEAST_GAP there is no sample.
        samples: (≥ count, COLUMNS) out. WEIGHT is 1/σ² (px⁻²) of the place, 0 where there is no
            step, -1 outside of the picture; ARC the angle a sample stands for.
    """
    height, width = image.shape
    profile = np.empty(TAPS)
    solved = np.zeros(5)
    spread = 0.0
    for k in range(TAPS):
        spread += filters[0, 2, k] * filters[0, 2, k]
    angle = 0.0
    count = 0
    long = 0.5 * (shape[2] + shape[4]) + np.sqrt(
        (0.5 * (shape[2] - shape[4])) ** 2 + shape[3] * shape[3]
    )
    short = (shape[2] * shape[4] - shape[3] * shape[3]) / long
    while angle < 2.0 * np.pi and count < samples.shape[0]:
        u0, u1 = np.cos(angle), np.sin(angle)
        row = samples[count]
        x, y, nx, ny, rx, ry = begin_sample(
            row, shape, lens, angle, u0, u1, REACH + 1.5, width, height
        )
        t0, t1 = -shape[2] * u1 + shape[3] * u0, -shape[3] * u1 + shape[4] * u0
        along = np.sqrt(t0 * t0 + t1 * t1)
        step = spacing_px / max(along, 0.2 * long)
        row[ARC] = min(step, 2.0 * np.pi - angle)
        angle += step
        count += 1
        if row[WEIGHT] < 0.0:
            continue
        # The nearest other edge on either side, along the normal.
        inner, outer = -_NO, _NO
        for k in range(others.shape[0]):
            away = -distance(others[k], x, y)  # how far outwards the other edge lies
            o = others[k]
            if (x - o[0]) * nx + (y - o[1]) * ny < 0.0:
                away = -away
            if away >= 0.0:
                outer = min(outer, away)
            else:
                inner = max(inner, away)
        if outer < LEAST_GAP or -inner < LEAST_GAP:
            continue
        bent = lens[12] != 0.0
        for k in range(TAPS):
            d = float(k - REACH)
            a, b = rx + d * nx, ry + d * ny
            if bent:
                a, b = bend(x + d * nx, y + d * ny, lens)
            column, line = int(a), int(b)
            fa, fb = a - column, b - line
            upper = image[line, column] * (1.0 - fa) + image[line, column + 1] * fa
            lower = image[line + 1, column] * (1.0 - fa) + image[line + 1, column + 1] * fa
            profile[k] = upper + fb * (lower - upper)
        level, contrast, shifted = _step(profile, filters[0])
        taken, room = spread, _NO
        if outer < REACH + 2.0 * blur_px or -inner < REACH + 2.0 * blur_px:
            taken = _crowded(profile, inner, outer, blur_px, solved)
            if taken < 0.0:
                continue
            level, contrast, shifted = solved[0], solved[1], solved[2]
            room = 0.6 * min(outer, -inner)
        row[CONTRAST] = contrast
        if contrast * sense < 0.0 or abs(contrast) < 2.5 * noise + 2.0:
            continue
        place = shifted / contrast
        left = 0.0
        for k in range(TAPS):
            e = profile[k] - level - contrast * basis[1, k] - shifted * basis[2, k]
            if room < _NO:
                e -= solved[3] * normal_cdf((k - REACH - outer) / blur_px)
                e -= solved[4] * normal_cdf((k - REACH - inner) / blur_px)
            left += e * e
        # What is left beyond noise is another edge, a shade or a curve of the step's own. An edge
        # that is not known of leaves the near side as it is: the widest window that fits counts.
        if left > _allowed(TAPS - 3, noise, contrast, place):
            for w in range(1, filters.shape[0]):
                first, last = WINDOWS[w][0] + REACH, WINDOWS[w][1] + REACH
                l2, c2, s2 = _step(profile, filters[w])
                if c2 * contrast <= 0.0 or abs(s2) > 1.6 * abs(c2):
                    continue
                rest = 0.0
                for k in range(first, last + 1):
                    rest += (profile[k] - l2 - c2 * basis[1, k] - s2 * basis[2, k]) ** 2
                if rest <= _allowed(last - first - 2, noise, c2, s2 / c2):
                    contrast, place, left, taken = c2, s2 / c2, rest, 0.0
                    for k in range(first, last + 1):
                        taken += filters[w, 2, k] ** 2
                    break
        if abs(place) > min(1.6, room):
            continue
        allowed = (TAPS - 3) * noise * noise + (0.08 * contrast) ** 2
        if left > 6.0 * allowed + 4.0:
            continue
        # A round body's blurred edge lies inside the true one by σ²/2ρ.
        curvature = long * short / max(along, 1e-9) ** 3
        row[OFFSET] = place + 0.5 * blur_px * blur_px * curvature
        variance = taken * (noise * noise + 0.1) / (contrast * contrast) + 4e-4
        row[WEIGHT] = 1.0 / variance
    return count
