"""Position of a blurred edge on a short profile of grey levels across it.

The model of one edge is ``b + c Φ((d − δ)/σ)``: level b, contrast c, place δ (px), blur σ (px).
Linear in b, c and c δ at δ = 0, so that least squares is one multiplication by a filter. Other
edges nearby are part of the model where they are known (`fit_adjacent`); where they are not known,
a narrower window of the profile leaves them out (`narrow_step`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.special import ndtr

from rendezview.geometry.normal_table import normal_cdf
from rendezview.geometry.pose import Array

REACH = 3  # px to either side of the expected edge. Source: by construction, 3 σ of a blur of 1 px
TAPS = 2 * REACH + 1  # samples of a profile, 1 px apart. Source: by construction
FAR = 1e9  # px: no edge there. Source: by construction
# First and last sample of a window, px from the edge: the whole profile, then one side with the
# edge, then the middle. Source: by construction
WINDOWS = ((-REACH, REACH), (-REACH, 1), (-1, REACH), (-2, 1), (-1, 2))
_ROOT_TWO_PI = 2.5066282746310002  # Source: by construction


def step_basis(blur_px: float) -> Array:
    """(3, TAPS) columns of the model in b, c and c δ, at δ = 0."""
    d = np.arange(-REACH, REACH + 1) / blur_px
    return np.vstack([np.ones(TAPS), ndtr(d), -np.exp(-0.5 * d * d) / (_ROOT_TWO_PI * blur_px)])


def step_filters(blur_px: float) -> Array:
    """(len(WINDOWS), 3, TAPS) filters that give b, c and c δ by least squares on each window."""
    basis = step_basis(blur_px)
    filters = np.zeros((len(WINDOWS), 3, TAPS))
    for window, (first, last) in zip(filters, WINDOWS, strict=True):
        taps = slice(first + REACH, last + REACH + 1)
        window[:, taps] = np.linalg.pinv(basis[:, taps].T)
    return filters


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def fit_step(profile: Array, window: Array) -> tuple[float, float, float]:
    """Level, contrast and contrast × place of a profile by a window of `step_filters`."""
    level, contrast, shifted = 0.0, 0.0, 0.0
    for k in range(TAPS):
        level += window[0, k] * profile[k]
        contrast += window[1, k] * profile[k]
        shifted += window[2, k] * profile[k]
    return level, contrast, shifted


@njit(cache=True, nogil=True)
def fit_adjacent(
    profile: Array, inner: float, outer: float, blur_px: float, solved: Array
) -> float:
    """Fit a profile by the edge at 0 together with known ones at ``inner`` and ``outer``, px.

    ``solved`` gets level, contrast, contrast × place, and the contrasts of the outer and the inner
    edge. Returns the variance of the third for unit noise, negative where there is no solution.
    """
    system = np.zeros((5, 7))  # normal equations, right side, unit vector of the third
    row = np.empty(5)
    for k in range(TAPS):
        d = float(k - REACH)
        z = d / blur_px
        row[0], row[1] = 1.0, normal_cdf(z)
        row[2] = -np.exp(-0.5 * z * z) / (_ROOT_TWO_PI * blur_px)
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
    solved[0] -= solved[4]  # the inner step is written from its far side
    return float(system[2, 6] / system[2, 2])


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def residual_square(
    profile: Array, basis: Array, level: float, contrast: float, shifted: float, inner: float,
    outer: float, blur_px: float, solved: Array, adjacent: bool,
) -> float:  # fmt: skip
    """Sum of squared residuals of a profile; with the two known edges where ``adjacent``."""
    left = 0.0
    for k in range(TAPS):
        e = profile[k] - level - contrast * basis[1, k] - shifted * basis[2, k]
        if adjacent:
            e -= solved[3] * normal_cdf((k - REACH - outer) / blur_px)
            e -= solved[4] * normal_cdf((k - REACH - inner) / blur_px)
        left += e * e
    return left


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def allowed_square(freedom: float, noise: float, contrast: float, place: float) -> float:
    """Residual that a step may have: noise, another blur, the model's error where it is far."""
    bend_grey = abs(contrast) * (0.02 + 0.2 * place * place)
    return 1.5 * freedom * (noise * noise + 0.1) + bend_grey * bend_grey


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def narrow_step(
    profile: Array, filters: Array, basis: Array, noise: float, contrast: float, farthest: float
) -> tuple[float, float, float, float]:
    """The widest narrower window in which the profile is a step of the same sense.

    Returns:
        Contrast, place, squared residual, variance of contrast × place for unit noise; the last
        negative where no window holds a step.
    """
    for w in range(1, filters.shape[0]):
        first, last = WINDOWS[w][0] + REACH, WINDOWS[w][1] + REACH
        l2, c2, s2 = fit_step(profile, filters[w])
        if c2 * contrast <= 0.0 or abs(s2) > farthest * abs(c2):
            continue
        rest = 0.0
        for k in range(first, last + 1):
            rest += (profile[k] - l2 - c2 * basis[1, k] - s2 * basis[2, k]) ** 2
        if rest <= allowed_square(last - first - 2, noise, c2, s2 / c2):
            taken = 0.0
            for k in range(first, last + 1):
                taken += filters[w, 2, k] ** 2
            return c2, s2 / c2, rest, taken
    return contrast, 0.0, 0.0, -1.0
