"""The fit of an edge profile, blurred by the camera, to grey levels along the normal."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.normal_table import DENSITY, PER_UNIT, PHI, REACH, normal_cdf
from rendezview.geometry.pose import Array

_INSIDE_PX, _OUTSIDE_PX = 3.2, 2.7  # px; window about the edge
_LEAST_PIXELS = 5  # for three or four unknowns. Source: by construction
_GAIN_SPREAD = 0.5  # one σ of the gain about 1. Source: by hand, seeds of docs/notes/refinement.md
# One σ of the tilt, of the largest step a pixel. Source: by hand, seeds of docs/notes/refinement.md
_TILT_SPREAD = 0.1
# grey levels, one σ of the model's own errors. Source: by hand, seeds of docs/notes/refinement.md
_MODEL_GREY = 3.0
_STEPS, _STOP_PX = 4, 0.02  # iterations at most, and the move in px after which they stop
_LONGEST_MOVE_PX = 0.6  # px, of one step. Source: by construction, less than the blur
# px from the steepest slope; further away the fit is another edge's. Source: by construction, as
# CLOSE_PX
_FURTHEST_PX = 1.5
_LEAST_GAIN = 0.05  # below, no edge is left. Source: by construction, a bound only
# px² for one grey level squared; above, the place is undetermined. Source: by construction, a bound
# only
_MOST_VARIANCE_PX2 = 1e3
_TAIL = 3.5  # σ; beyond, Φ counts as 0 or 1. Source: by construction (2e-4)
_HELD = 1e9  # information that holds an unknown. Source: by construction
# Of a surface that is white in the frame: how much brighter it may be. Source: by construction,
# log-even, as nobody knows
_GAINS = np.geomspace(1.0, 6.0, 6)
_NO_FIT = 1e30  # cost of a gain with which nothing fits. Source: by construction, a bound only
_GAIN_STEPS = 5  # at most, of place and background for each. Source: by construction

Flags = npt.NDArray[np.bool_]

# Upper triangle of the normal equations a00 a01 a02 a03 a11 a12 a13 a22 a23 (a33 is the number of
# pixels), their right side r0 … r3, and the sum of squares.
_Sums = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float
]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def fit_profile(
    profile: Array, count: int, zero: int, start: float, depths: Array, levels: Array, steps: int,
    background: float, held: bool, sigma: float, noise: float, result: Array,
) -> bool:  # fmt: skip
    """Place an edge where its profile of surfaces fits the grey levels.

    Least squares of ``background + gain Σ_k (b_k − b_{k−1}) Φ((d − d_k) / σ) + tilt d Φ(d / σ)``
    with ``d`` the depth inside the edge: surfaces of brightness b_k that begin at depths d_k, under
    the camera's blur σ. Free are the place, the gain, a little tilt for shading that the model
    does not know, and, unless it is ``held``, the background.

    Args:
        profile: (≥ count,) grey levels at whole pixels, from inside to outside.
        zero: index of the pixel at place 0.
        start: place of the steepest slope.
        depths, levels: (≥ steps,) d_k, pixels, and b_k − b_{k−1}, grey levels.
        sigma: of the blur, pixels.
        noise: of a grey level of the profile, one σ.
        result: (2,) gets the place, pixels outwards, and its variance.

    Returns:
        Whether it fits.
    """
    inverse = 1.0 / sigma
    place, gain, tilt, base = start, 1.0, 0.0, background
    height = 0.0
    for k in range(steps):
        height = max(height, abs(levels[k]))
    variance, used, cost = 0.0, 0, 0.0
    for step in range(_STEPS):
        first, last, used = _window(place, zero, count)
        if used < _LEAST_PIXELS:
            return False
        sums = _sums(
            profile, first, last, zero, place, gain, tilt, base, inverse, depths, levels, steps
        )
        cost = sums[13]
        move, more, bend, lift, variance = _solved(
            sums, used, gain, tilt, height, noise, held, step == 0
        )
        place += min(max(move, -_LONGEST_MOVE_PX), _LONGEST_MOVE_PX)
        gain += more
        tilt += bend
        base += lift
        if gain <= _LEAST_GAIN:
            return False
        if step > 0 and abs(move) < _STOP_PX:
            break
    if abs(place - start) > _FURTHEST_PX or variance > _MOST_VARIANCE_PX2:
        return False
    result[0] = place
    result[1] = (cost / (used - 3) + noise * noise) * variance
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def fit_clipped_profile(
    profile: Array, clipped: Flags, count: int, zero: int, start: float, depths: Array,
    levels: Array, steps: int, background: float, held: bool, sigma: float, noise: float,
    result: Array,
) -> bool:  # fmt: skip
    """``fit_profile`` where a few levels are ``clipped`` at white: those are lower bounds.

    How much brighter the surface is shows only in the flank of the edge, so the place is found for
    each of some gains, without a tilt; the result is their mean by likelihood (Tobin 1958).
    """
    inverse = 1.0 / sigma
    grey2 = _MODEL_GREY * _MODEL_GREY + noise * noise
    places, variances, costs = np.empty(_GAINS.size), np.empty(_GAINS.size), np.empty(_GAINS.size)
    least = _NO_FIT
    for k in range(_GAINS.size):
        place, base, cost, variance, used = start, background, 0.0, 0.0, 0
        for _ in range(_GAIN_STEPS):
            first, last, used = _window(place, zero, count)
            if used < _LEAST_PIXELS:
                return False
            a00, a03, a33, r0, r3 = 1e-6, 0.0, _HELD if held else 1e-6, 0.0, 0.0
            cost = 0.0
            for i in range(first, last + 1):
                shape, slope = _shape_at(place - (i - zero), inverse, depths, levels, steps)
                r, j0 = profile[i] - base - _GAINS[k] * shape, _GAINS[k] * slope * inverse
                if clipped[i] and r < 0.0:
                    continue
                cost += r * r
                a00 += j0 * j0
                a03 += j0
                a33 += 1.0
                r0 += j0 * r
                r3 += r
            variance = 1.0 / (a00 - a03 * a03 / a33)
            move = variance * (r0 - r3 * a03 / a33)
            place += min(max(move, -_LONGEST_MOVE_PX), _LONGEST_MOVE_PX)
            base += (r3 - a03 * move) / a33
            if abs(move) < _STOP_PX:
                break
        far = abs(place - start) > _FURTHEST_PX or variance > _MOST_VARIANCE_PX2
        places[k], costs[k] = place, _NO_FIT if far else cost
        variances[k] = (cost / (used - 2) + noise * noise) * variance
        least = min(least, costs[k])
    if least == _NO_FIT:
        return False
    total, mean, spread = 0.0, 0.0, 0.0
    for k in range(_GAINS.size):
        share = np.exp(-0.5 * (costs[k] - least) / grey2)
        total += share
        mean += share * places[k]
        spread += share * variances[k]
    result[0], result[1] = mean / total, spread / total
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def _window(place: float, zero: int, count: int) -> tuple[int, int, int]:
    """First and last pixel of a profile beside an edge, and how many those are."""
    first = max(0, int(np.ceil(place - _INSIDE_PX)) + zero)
    last = min(count - 1, int(np.floor(place + _OUTSIDE_PX)) + zero)
    return first, last, last - first + 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def _shape_at(
    d: float, inverse: float, depths: Array, levels: Array, steps: int
) -> tuple[float, float]:
    """Grey levels of the model's profile at a depth, and σ times their slope."""
    shape, slope = 0.0, 0.0
    for k in range(steps):
        z = (d - depths[k]) * inverse
        if z > _TAIL:
            shape += levels[k]
        elif z > -_TAIL:
            at = (z + REACH) * PER_UNIT
            cell = int(at)
            part = at - cell
            shape += levels[k] * (PHI[cell] + part * (PHI[cell + 1] - PHI[cell]))
            slope += levels[k] * (DENSITY[cell] + part * (DENSITY[cell + 1] - DENSITY[cell]))
    return shape, slope


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _sums(
    profile: Array, first: int, last: int, zero: int, place: float, gain: float, tilt: float,
    base: float, inverse: float, depths: Array, levels: Array, steps: int,
) -> _Sums:  # fmt: skip
    """Normal equations of place, gain, tilt and background over some pixels; see `_Sums`."""
    a00 = a01 = a02 = a03 = a11 = a12 = a13 = a22 = a23 = 0.0
    r0 = r1 = r2 = r3 = cost = 0.0
    for i in range(first, last + 1):
        d = place - (i - zero)
        shape, slope = _shape_at(d, inverse, depths, levels, steps)
        share = normal_cdf(d * inverse)
        j0, j1, j2 = gain * slope * inverse + tilt * share, shape, d * share
        r = profile[i] - base - gain * shape - tilt * j2
        cost += r * r
        a00 += j0 * j0
        a01 += j0 * j1
        a02 += j0 * j2
        a03 += j0
        a11 += j1 * j1
        a12 += j1 * j2
        a13 += j1
        a22 += j2 * j2
        a23 += j2
        r0 += j0 * r
        r1 += j1 * r
        r2 += j2 * r
        r3 += r
    return a00, a01, a02, a03, a11, a12, a13, a22, a23, r0, r1, r2, r3, cost


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _solved(
    sums: _Sums, used: int, gain: float, tilt: float, height: float, noise: float, held: bool,
    first: bool,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Steps of place, gain, tilt and background, and the variance of the place."""
    a00, a01, a02, a03, a11, a12, a13, a22, a23, r0, r1, r2, r3, _ = sums
    # Prior knowledge counts as one more reading each, as uncertain as a few grey levels.
    uncertain = _MODEL_GREY * _MODEL_GREY + noise * noise
    known = uncertain / (_GAIN_SPREAD * _GAIN_SPREAD)
    a11 += known
    r1 += known * (1.0 - gain)
    spread = _TILT_SPREAD * height + 1e-3
    known = uncertain / (spread * spread)
    a22 += known
    r2 -= known * tilt
    a33 = float(used)
    if held:
        a33 += _HELD
    a00 += _HELD if first else 1e-6  # gain, tilt and background first
    # Background, tilt and gain are eliminated in turn, which leaves the equation of the place.
    f = a23 / a33
    a22 -= f * a23
    a12 -= f * a13
    a02 -= f * a03
    r2 -= f * r3
    f = a13 / a33
    a11 -= f * a13
    a01 -= f * a03
    r1 -= f * r3
    f = a03 / a33
    a00 -= f * a03
    r0 -= f * r3
    f = a12 / a22
    a11 -= f * a12
    a01 -= f * a02
    r1 -= f * r2
    f = a02 / a22
    a00 -= f * a02
    r0 -= f * r2
    f = a01 / a11
    a00 -= f * a01
    r0 -= f * r1
    move = r0 / a00
    more = (r1 - a01 * move) / a11
    bend = (r2 - a02 * move - a12 * more) / a22
    lift = (r3 - a03 * move - a13 * more - a23 * bend) / a33
    return move, more, bend, lift, 1.0 / a00
