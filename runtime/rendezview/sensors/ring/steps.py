"""The exact place of an ellipse's edge: a blurred step in the grey picture along its normals.

The accuracy of the ring's pose comes from these samples. Other edges nearby are part of the model
where they are known, and narrower windows leave them out where they are not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.edge_profile import (
    FAR,
    REACH,
    TAPS,
    allowed_square,
    fit_adjacent,
    fit_step,
    narrow_step,
    residual_square,
)
from rendezview.geometry.lens import LENS_LENGTH
from rendezview.sensors.ring.conic import distance, semi_axes
from rendezview.sensors.ring.samples import (
    ARC,
    CONTRAST,
    OFFSET,
    WEIGHT,
    begin_sample,
    bend,
)

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

# From the ellipse, of an edge that the linear model places. Source: by hand; see ring-accuracy
_FARTHEST_PX = 1.6
# px², variance of a place beside the noise: (0.02 px)². Source: by hand; see ring-accuracy
_FLOOR_PX2 = 4e-4


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def sample_steps(
    image: Grey, lens: Array, shape: Array, spacing_px: float, sense: float, noise: float,
    filters: Array, basis: Array, blur_px: float, others: Array, samples: Array,
) -> int:  # fmt: skip
    """Blurred steps along the normals of an ellipse; returns the number of samples filled.

    Args:
        image: (H, W) uint8.
        spacing_px: between samples along the ellipse.
        sense: 1 where the edge gets brighter outwards, -1 where darker; 0 takes both.
        noise: σ of a pixel, grey.
        filters, basis: of `step_filters` and `step_basis`; ``blur_px`` their σ.
        others: (K, 5) shapes of other edges: their steps are part of the fit where they are near.
        samples: (≥ count, COLUMNS) out. WEIGHT is 1/σ² (px⁻²) of the place, 0 where there is no
            step, -1 outside of the picture; ARC the angle a sample represents.
    """
    height, width = image.shape
    profile, solved = np.empty(TAPS), np.zeros(5)
    spread = 0.0
    for k in range(TAPS):
        spread += filters[0, 2, k] * filters[0, 2, k]
    angle, count = 0.0, 0
    long, short = semi_axes(shape)
    while angle < 2.0 * np.pi and count < samples.shape[0]:
        u0, u1 = np.cos(angle), np.sin(angle)
        row = samples[count]
        x, y, nx, ny, rx, ry = begin_sample(
            row, shape, lens, angle, u0, u1, REACH + 1.5, width, height
        )
        t0, t1 = -shape[2] * u1 + shape[3] * u0, -shape[3] * u1 + shape[4] * u0
        along = np.sqrt(t0 * t0 + t1 * t1)
        step = spacing_px / along
        row[ARC] = min(step, 2.0 * np.pi - angle)
        angle += step
        count += 1
        if row[WEIGHT] < 0.0:
            continue
        inner, outer = _neighbours(others, x, y, nx, ny)
        _read_profile(image, lens, x, y, nx, ny, rx, ry, profile)
        row[CONTRAST], contrast, place, taken = _place_step(
            profile, inner, outer, sense, noise, filters, basis, blur_px, spread, solved
        )
        if taken < 0.0:
            continue
        # A round body's blurred edge lies inside the true one by σ²/2ρ.
        curvature = long * short / max(along, 1e-9) ** 3
        row[OFFSET] = place + 0.5 * blur_px * blur_px * curvature
        variance = taken * (noise * noise + 0.1) / (contrast * contrast) + _FLOOR_PX2
        row[WEIGHT] = 1.0 / variance
    return count


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _neighbours(others: Array, x: float, y: float, nx: float, ny: float) -> tuple[float, float]:
    """How far along a normal the nearest other edge lies inwards (negative) and outwards, px."""
    inner, outer = -FAR, FAR
    for k in range(others.shape[0]):
        away = -distance(others[k], x, y)
        o = others[k]
        if (x - o[0]) * nx + (y - o[1]) * ny < 0.0:
            away = -away
        if away >= 0.0:
            outer = min(outer, away)
        else:
            inner = max(inner, away)
    return inner, outer


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _read_profile(
    image: Grey, lens: Array, x: float, y: float, nx: float, ny: float, rx: float, ry: float,
    profile: Array,
) -> None:  # fmt: skip
    """Grey levels along a normal, by bilinear interpolation."""
    bent = lens[LENS_LENGTH] != 0.0
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _place_step(
    profile: Array, inner: float, outer: float, sense: float, noise: float, filters: Array,
    basis: Array, blur_px: float, spread: float, solved: Array,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Contrast of the whole profile; contrast and place of the step; variance of their product.

    The variance is for unit noise, negative where there is no step.
    """
    level, contrast, shifted = fit_step(profile, filters[0])
    taken, room = spread, FAR
    adjacent = outer < REACH + 2.0 * blur_px or -inner < REACH + 2.0 * blur_px
    if adjacent:
        taken = fit_adjacent(profile, inner, outer, blur_px, solved)
        if taken < 0.0:
            return 0.0, 0.0, 0.0, -1.0
        level, contrast, shifted = solved[0], solved[1], solved[2]
        room = 0.6 * min(outer, -inner)
    if contrast * sense < 0.0 or abs(contrast) < 2.5 * noise + 2.0:
        return contrast, contrast, 0.0, -1.0
    place, fitted = shifted / contrast, contrast
    left = residual_square(
        profile, basis, level, contrast, shifted, inner, outer, blur_px, solved, adjacent
    )
    # A residual beyond noise is another edge, a shade or a curve of the step's own. An unknown
    # edge leaves the near side as it is: the widest window that fits counts.
    if left > allowed_square(TAPS - 3, noise, contrast, place):
        c2, p2, rest, variance = narrow_step(profile, filters, basis, noise, contrast, _FARTHEST_PX)
        if variance >= 0.0:
            contrast, place, left, taken = c2, p2, rest, variance
    if abs(place) > min(_FARTHEST_PX, room):
        return fitted, contrast, 0.0, -1.0
    allowed = (TAPS - 3) * noise * noise + (0.08 * contrast) ** 2
    if left > 6.0 * allowed:
        return fitted, contrast, 0.0, -1.0
    return fitted, contrast, place, taken
