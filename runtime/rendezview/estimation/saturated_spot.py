"""The centre of a saturated spot, from the pixels of its rim.

A saturated pixel shows only that there is light. Where charge runs over from it, along a column
or a row, its neighbours show not even that, and every centroid follows the charge. The rest of the
rim stays as it was. A blurred disc falls with the distance from the edge of an ellipse like the
integral Φ of the normal distribution:

    v = A Φ((r(θ) − ρ) / s),  r(θ) = R / √(1 − 2 (e₁ cos 2θ + e₂ sin 2θ))                   (1)

above the background, at distance ρ and direction θ from the centre. Least squares on centre, R,
e₁, e₂, ln s and ln A use the pixels that are not saturated. Where one side of the rim is missing,
the centre is still right, if less precise. The last pixel that charge ran into is only partly full.
A first fit therefore leaves out all neighbours of saturated pixels. The second leaves out those on
the sides on which one of them is not as the first predicts.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.least_squares import (
    DAMPING_DECAY,
    DAMPING_GROWTH,
    FIRST_DAMPING,
    MOST_STEPS,
    damped_step,
)
from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into, invert
from rendezview.geometry.pose import Array

Grey = npt.NDArray[np.uint8]
Box = tuple[int, int, int, int]  # first and last column, first and last row, all inclusive
Plane = tuple[float, float, float, float, float]  # x, y, grey there and its slopes

FULL_GREY = 250  # grey: brighter may be cut off. Source: by construction, 255 less 2 σ of noise
_NUMBERS = 7  # x, y, R, e₁, e₂, ln s, ln A. Source: by construction
_PRIORS = 4  # of the last of these something is known before. Source: by construction
_BEYOND_PX = 4  # of the spot's box. Source: by construction, 4 σ of the blur and a pixel's width
_TRIALS = 6  # of damping. Source: by construction, a bound only
_GAIN = 1e-3  # of χ²: the end. Source: by construction, a thirtieth of one σ
_LONGEST = 1.5  # of a step of ln s and ln A. Source: by construction, a factor of 4.5
# What is known before: a blur (px) and a peak (grey) within a factor e^±σ, and the flattening
# of a disc that is tilted by 25° (one σ). Source: by construction, weak beside a rim of 20 pixels
_BLUR_PX, _LN_BLUR = 0.8, 0.2
_PEAK_GREY, _LN_PEAK = 400.0, 1.0
_FLAT = 0.1  # Source: as above
# σ of what (1) predicts for a neighbour, by which charge shows that ran into it. Source: by
# construction, by chance in one of 20 spots, which costs precision only
_OTHERWISE = 3.5
_ALL_SIDES = 15  # Source: by construction, the sum of `_beside_full`
# χ² a degree of freedom beyond which something else lies over the spot. Source: by construction,
# twice the noise
_STRANGE = 4.0


@njit(cache=True, nogil=True, error_model="numpy")
def fit_rim(
    image: Grey, dark: Grey, plane: Plane, radius: float, noise: float, box: Box
) -> tuple[float, float, float]:
    """Centre x, y of a saturated spot and its error, one σ an axis, px; 0 where (1) does not fit.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        plane: a place near the centre, px, the background's grey there and its slopes, grey a px.
        radius: of the disc, about, px.
        noise: of a pixel, grey.
        box: of the spot.
    """
    height, width = image.shape
    window = (
        max(box[0] - _BEYOND_PX, 0), min(box[1] + _BEYOND_PX, width - 1),
        max(box[2] - _BEYOND_PX, 0), min(box[3] + _BEYOND_PX, height - 1),
    )  # fmt: skip
    at, covariance = np.zeros(_NUMBERS), np.empty((_NUMBERS, _NUMBERS))
    at[0], at[1], at[2] = plane[0], plane[1], radius
    at[5], at[6] = math.log(_BLUR_PX), math.log(_PEAK_GREY)
    prior = at.copy()
    apart = int(np.int64(_ALL_SIDES))  # as a literal, numba would compile a copy for it
    ratio = _fit(image, dark, plane, noise, window, apart, prior, at, covariance)
    if ratio < _STRANGE:
        sides = _ran_over(image, dark, plane, noise, ratio, window, at, covariance)
        again, sure = at.copy(), covariance.copy()
        ratio_again = _fit(image, dark, plane, noise, window, sides, prior, again, sure)
        if ratio_again < _STRANGE:
            ratio = ratio_again
            copy_into(again, at)
            copy_matrix_into(sure, covariance)
    if not ratio < _STRANGE:
        return plane[0], plane[1], 0.0
    variance = 0.5 * (covariance[0, 0] + covariance[1, 1])
    return at[0], at[1], math.sqrt(max(ratio, 1.0) * variance)


@njit(cache=True, nogil=True, error_model="numpy")
def _ran_over(
    image: Grey, dark: Grey, plane: Plane, noise: float, ratio: float, box: Box, at: Array,
    covariance: Array,
) -> int:  # fmt: skip
    """The sides of saturated pixels, as a sum, on which a neighbour is not as (1) predicts."""
    slope, sides = np.empty(_NUMBERS), 0
    for v in range(box[2], box[3] + 1):
        for u in range(box[0], box[1] + 1):
            beside = _beside_full(image, u, v)
            if image[v, u] >= FULL_GREY or beside == 0 or beside | sides == sides:
                continue
            off = _above(image, dark, plane, u, v) - disc_light(at, u, v, slope)
            variance = noise * noise
            for a in range(_NUMBERS):
                for b in range(_NUMBERS):
                    variance += slope[a] * covariance[a, b] * slope[b]
            if off * off > _OTHERWISE * _OTHERWISE * max(ratio, 1.0) * variance:
                sides |= beside
    return sides


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(
    image: Grey, dark: Grey, plane: Plane, noise: float, box: Box, apart: int, prior: Array,
    at: Array, covariance: Array,
) -> float:  # fmt: skip
    """Levenberg–Marquardt on the numbers ``at``; χ² a degree of freedom of the rim, infinite for
    no fit."""
    trial, step = np.empty(_NUMBERS), np.empty(_NUMBERS)
    normal, right = np.empty((_NUMBERS, _NUMBERS)), np.empty(_NUMBERS)
    normal_there, right_there, lower = np.empty_like(normal), right.copy(), np.empty_like(normal)
    cost, rim, count = _equations(image, dark, plane, noise, box, apart, prior, at, normal, right)
    damping, gain = 0.0, np.inf
    for _ in range(MOST_STEPS):
        gain = -1.0
        for _ in range(_TRIALS):
            if damped_step(normal, right, damping, lower, step):
                for a in range(_NUMBERS):
                    trial[a] = at[a] + step[a]
                if trial[2] > 0.0 and max(abs(step[5]), abs(step[6])) < _LONGEST:
                    there, rim_there, count_there = _equations(
                        image, dark, plane, noise, box, apart, prior, trial, normal_there,
                        right_there,
                    )  # fmt: skip
                    if there <= cost:
                        gain, cost, rim, count = cost - there, there, rim_there, count_there
                        copy_into(trial, at)
                        copy_matrix_into(normal_there, normal)
                        copy_into(right_there, right)
                        damping *= DAMPING_DECAY
                        break
            damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        if gain < _GAIN:
            break
    if count <= _NUMBERS or not (math.isfinite(cost) and invert(normal, lower, covariance)):
        return np.inf
    return rim / (count - _NUMBERS)


@njit(cache=True, nogil=True, error_model="numpy")
def _equations(
    image: Grey, dark: Grey, plane: Plane, noise: float, box: Box, apart: int, prior: Array,
    at: Array, normal: Array, right: Array,
) -> tuple[float, float, int]:  # fmt: skip
    """χ² of (1), in all and of the pixels of the rim and what is known before; the number of these.

    Normal equations (7, 7) and (7,) in place.

    ``apart``: without neighbours on these sides of saturated pixels, see `_beside_full`.
    """
    slope, cost, count = np.empty(_NUMBERS), 0.0, _PRIORS
    for a in range(_NUMBERS):
        right[a] = 0.0
        for b in range(a + 1):
            normal[a, b] = 0.0
    for a in range(_NUMBERS - _PRIORS, _NUMBERS):
        weight = (_FLAT if a < 5 else _LN_BLUR if a == 5 else _LN_PEAK) ** -2.0
        normal[a, a], right[a] = weight, weight * (prior[a] - at[a])
        cost += weight * (prior[a] - at[a]) ** 2
    rim = cost
    weight = 1.0 / (noise * noise)
    for v in range(box[2], box[3] + 1):
        for u in range(box[0], box[1] + 1):
            if image[v, u] >= FULL_GREY or _beside_full(image, u, v) & apart:
                continue
            off = _above(image, dark, plane, u, v) - disc_light(at, u, v, slope)
            cost += weight * off * off
            if slope[6] > noise:  # the others are the background's
                rim += weight * off * off
                count += 1
            for a in range(_NUMBERS):
                right[a] += weight * slope[a] * off
                for b in range(a + 1):
                    normal[a, b] += weight * slope[a] * slope[b]
    for a in range(_NUMBERS):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return cost, rim, count


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _above(image: Grey, dark: Grey, plane: Plane, u: int, v: int) -> float:
    """Grey of a pixel above the background."""
    value = float(image[v, u]) - plane[2]
    if dark.shape[0] > 0:
        value -= dark[v, u]
    return value - plane[3] * (u - plane[0]) - plane[4] * (v - plane[1])


@njit(cache=True, nogil=True, error_model="numpy")
def disc_light(at: Array, u: float, v: float, slope: Array) -> float:
    """(1) at a pixel, grey; its derivatives by the seven numbers ``at`` into ``slope`` (7,)."""
    dx, dy = u - at[0], v - at[1]
    soft, peak = math.exp(at[5]), math.exp(at[6])
    square = max(dx * dx + dy * dy, 1e-6)
    far, cos2, sin2 = math.sqrt(square), (dx * dx - dy * dy) / square, 2.0 * dx * dy / square
    g = max(1.0 - 2.0 * (at[3] * cos2 + at[4] * sin2), 0.2)
    rim = at[2] / math.sqrt(g)
    t = (rim - far) / soft
    density = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    inside, k, bend = 0.5 * math.erfc(-t / math.sqrt(2.0)), peak * density / soft, rim / g
    along = 2.0 * bend * (at[4] * cos2 - at[3] * sin2)  # dr/dθ
    slope[0] = k * (dx / far + along * dy / square)
    slope[1] = k * (dy / far - along * dx / square)
    slope[2], slope[3], slope[4] = k * rim / at[2], k * bend * cos2, k * bend * sin2
    slope[5], slope[6] = -peak * density * t, peak * inside
    return peak * inside


@njit(cache=True, nogil=True, error_model="numpy")
def _beside_full(image: Grey, u: int, v: int) -> int:
    """On which sides of saturated pixels a pixel lies: 1 left, 2 right, 4 above and 8 below."""
    height, width = image.shape
    sides = 0
    if u + 1 < width and image[v, u + 1] >= FULL_GREY:
        sides |= 1
    if u > 0 and image[v, u - 1] >= FULL_GREY:
        sides |= 2
    if v + 1 < height and image[v + 1, u] >= FULL_GREY:
        sides |= 4
    if v > 0 and image[v - 1, u] >= FULL_GREY:
        sides |= 8
    return sides
