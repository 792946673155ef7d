"""Strips of surfaces beside an edge: as they are seen from a pose, and fitted to a profile.

The model keeps what lies beside an edge as one of its views shows it. Seen from elsewhere a facet
is wider or narrower, and the rim of an outline ends where its inner end is seen, or is hidden.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.appearance.contours import CELLS, CREASE, INNER_CELLS, OUTLINE_CELLS
from rendezview.normal_table import DENSITY, PER_UNIT, PHI, REACH, normal_cdf

_INSIDE_PX, _OUTSIDE_PX = 4.2, 3.2  # of an edge: what its strip is fitted to
_EDGE_ON = 0.05  # cosine below which a facet's width in the model's view says nothing
_WIDEST = 3.0  # than in that view
_AT_EDGE = int(np.searchsorted(INNER_CELLS, 0.0)) + 1  # the first cell inside an inner edge
_STEP_GREY = 5.0  # of brightness within a strip; smaller ones are left out
_GAIN_SPREAD = 0.3  # of the brightness that is expected
_TILT_SPREAD = 0.1  # a pixel, of the strip's contrast
_MODEL_GREY = 3.0  # what the strip leaves unexplained anyway


@njit(cache=True, nogil=True, fastmath=True)
def strip_place(  # type: ignore[no-untyped-def]
    profile, count, zero, start, depths, levels, steps, background, held, sigma, noise, result,
):  # fmt: skip
    """Place an edge where the strip of surfaces that the model has there fits the profile.

    Least squares of ``background + gain Σ_k (b_k − b_{k−1}) Φ((d − d_k) / σ) + tilt d Φ(d / σ)``
    with ``d`` the depth inside the edge: what the camera's blur σ makes of surfaces of brightness
    b_k that begin at depths d_k. Free are the place, the gain, a little tilt, for what the model
    does not know of the shading, and, unless it is ``held``, the background.

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
    variance, seen, cost = 0.0, 0, 0.0
    for step in range(4):
        first = max(0, int(np.ceil(place - _INSIDE_PX)) + zero)
        last = min(count - 1, int(np.floor(place + _OUTSIDE_PX)) + zero)
        seen = last - first + 1
        if seen < 5:
            return False
        # Upper triangle of the normal equations, and their right side.
        a00 = a01 = a02 = a03 = a11 = a12 = a13 = a22 = a23 = 0.0
        r0 = r1 = r2 = r3 = cost = 0.0
        for i in range(first, last + 1):
            d = place - (i - zero)
            shape, slope = 0.0, 0.0
            for k in range(steps):
                z = (d - depths[k]) * inverse
                if z > 3.5:
                    shape += levels[k]
                elif z > -3.5:
                    at = (z + REACH) * PER_UNIT
                    cell = int(at)
                    part = at - cell
                    shape += levels[k] * (PHI[cell] + part * (PHI[cell + 1] - PHI[cell]))
                    slope += levels[k] * (
                        DENSITY[cell] + part * (DENSITY[cell + 1] - DENSITY[cell])
                    )
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
        a33 = float(seen)
        # What is known beforehand, as one more reading each, as sure as a few grey levels.
        sure = _MODEL_GREY * _MODEL_GREY + noise * noise
        known = sure / (_GAIN_SPREAD * _GAIN_SPREAD)
        a11 += known
        r1 += known * (1.0 - gain)
        spread = _TILT_SPREAD * height + 1e-3
        known = sure / (spread * spread)
        a22 += known
        r2 -= known * tilt
        if held:
            a33 += 1e9
        a00 += 1e9 if step == 0 else 1e-6  # the others first
        # Background, tilt and gain are eliminated; what is left is the place's own equation.
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
        variance = 1.0 / a00
        more = (r1 - a01 * move) / a11
        bend = (r2 - a02 * move - a12 * more) / a22
        place += min(max(move, -0.6), 0.6)
        gain += more
        tilt += bend
        base += (r3 - a03 * move - a13 * more - a23 * bend) / a33
        if gain <= 0.05:
            return False
        if step > 0 and abs(move) < 0.02:
            break
    if abs(place - start) > 1.5 or variance > 1e3:
        return False
    result[0] = place
    result[1] = (cost / (seen - 3) + noise * noise) * variance
    return True


@njit(cache=True, nogil=True, fastmath=True)
def across(eye, x, y, z, tangent, out):  # type: ignore[no-untyped-def]
    """Directions at a point that is seen from ``eye``, target axes: to the camera without what
    runs along the edge there (3,), and outwards in the picture (3,).
    """
    w0, w1, w2 = eye[0] - x, eye[1] - y, eye[2] - z
    t0, t1, t2 = float(tangent[0]), float(tangent[1]), float(tangent[2])
    o0, o1, o2 = t2 * w1 - t1 * w2, t0 * w2 - t2 * w0, t1 * w0 - t0 * w1
    along = (w0 * t0 + w1 * t1 + w2 * t2) / (t0 * t0 + t1 * t1 + t2 * t2 + 1e-9)
    w0, w1, w2 = w0 - along * t0, w1 - along * t1, w2 - along * t2
    inverse = 1.0 / (np.sqrt(w0 * w0 + w1 * w1 + w2 * w2) + 1e-30)
    out[0], out[1], out[2] = w0 * inverse, w1 * inverse, w2 * inverse
    inverse = 1.0 / (np.sqrt(o0 * o0 + o1 * o1 + o2 * o2) + 1e-30)
    out[3], out[4], out[5] = o0 * inverse, o1 * inverse, o2 * inverse


@njit(cache=True, nogil=True, fastmath=True)
def _wider(surface, seen, drawn):  # type: ignore[no-untyped-def]
    """How much wider a facet beside an edge is seen than in the model's view of it."""
    if surface[3] == 0.0:
        return 1.0
    now = surface[0] * seen[0] + surface[1] * seen[1] + surface[2] * seen[2]
    then = surface[0] * drawn[0] + surface[1] * drawn[1] + surface[2] * drawn[2]
    if then < 0.0:
        now, then = -now, -then
    return min(max(now / max(then, _EDGE_ON), 0.0), _WIDEST)


@njit(cache=True, nogil=True, fastmath=True)
def rim_end(x, y, z, wide, deep, drawn, away, rotation, centre):  # type: ignore[no-untyped-def]
    """Where the inner end of a rim is seen, normalised (x, y), which in the model's view lies
    ``wide`` metres inside the point (x, y, z) and ``deep`` metres beyond it.

    Args:
        drawn: (6,) of ``across`` from the camera of the model's view.
        away: (3,) unit, from that camera to the point, target axes.
        rotation, centre: of the pose, camera frame.
    """
    bx = x - wide * drawn[3] + deep * away[0]
    by = y - wide * drawn[4] + deep * away[1]
    bz = z - wide * drawn[5] + deep * away[2]
    u = rotation[0, 0] * bx + rotation[0, 1] * by + rotation[0, 2] * bz + centre[0]
    v = rotation[1, 0] * bx + rotation[1, 1] * by + rotation[1, 2] * bz + centre[1]
    w = rotation[2, 0] * bx + rotation[2, 1] * by + rotation[2, 2] * bz + centre[2]
    inverse = 1.0 / w
    return u * inverse, v * inverse


@njit(cache=True, nogil=True, fastmath=True)
def in_shadow(wide, deep, sunward, drawn, away):  # type: ignore[no-untyped-def]
    """Whether what rises at the inner end of a rim casts its shadow over all of it."""
    over = -(sunward[0] * drawn[3] + sunward[1] * drawn[4] + sunward[2] * drawn[5])
    up = -(sunward[0] * away[0] + sunward[1] * away[1] + sunward[2] * away[2])
    return deep < 0.0 and over > 0.0 and -deep * over > wide * max(up, 0.0)


@njit(cache=True, nogil=True, fastmath=True)
def outline_strip(  # type: ignore[no-untyped-def]
    strip, palette, shade, seen, drawn, rim, rim_px, shaded, inner_px, scale, depths, levels
):
    """Depths and steps in brightness of an outline's strip; how many.

    The facets' widths are those of the model's view, foreshortened as they are seen from here.

    Args:
        rim: width of the rim in the model's view, of the target's radius; 0: none.
        rim_px: its width as it is seen; where it is hidden, what lies behind is the outline.
        shaded: whether what rises at the rim's inner end casts its shadow over it.
    """
    steps, before, depth = 0, 0.0, 0.0
    first = 0
    if rim > 0.0 and rim_px <= 0.0:
        first, depth = 1, rim_px
    for cell in range(first, CELLS):
        level = shade[strip[cell]]
        if cell == 0 and shaded:
            level = 0.0
        if cell == first or abs(level - before) > _STEP_GREY:
            at = depth
            thin = strip[cell] == 0 and cell > 0 and inner_px < depth + 2.0
            if thin and not (cell == 1 and rim > 0.0):
                at = inner_px  # the width of a thin body is known better than to a cell
            depths[steps], levels[steps] = at, level - before
            steps += 1
            before = level
        if cell == 0 and rim > 0.0:
            depth = rim_px
        elif cell < CELLS - 1:
            near = rim if cell == 1 and rim > 0.0 else OUTLINE_CELLS[cell]
            wider = _wider(palette[strip[cell]], seen, drawn)
            depth += (OUTLINE_CELLS[cell + 1] - near) * wider * scale
    return steps


@njit(cache=True, nogil=True, fastmath=True)
def inner_strip(  # type: ignore[no-untyped-def]
    kind, strip, palette, shade, seen, drawn, inner_px, scale, depths, levels
):
    """The same of an inner edge; the first level is left out: it is the background."""
    steps, before = 0, shade[strip[0]]
    depth = INNER_CELLS[0] * scale
    if kind == CREASE:
        depth = 0.0
        for cell in range(1, _AT_EDGE):
            width = INNER_CELLS[cell] - INNER_CELLS[cell - 1]
            depth -= width * _wider(palette[strip[cell]], seen, drawn) * scale
    for cell in range(1, CELLS):
        level = shade[strip[cell]]
        if abs(level - before) > _STEP_GREY:
            at = depth
            if strip[cell] == 0 and inner_px < depth + 2.0:
                at = inner_px  # of a thin body: known better than to a cell
            depths[steps], levels[steps] = at, level - before
            steps += 1
            before = level
        if cell < CELLS - 1:
            wider = 1.0
            if kind == CREASE or cell >= _AT_EDGE:
                wider = _wider(palette[strip[cell]], seen, drawn)
            depth += (INNER_CELLS[cell] - INNER_CELLS[cell - 1]) * wider * scale
    return steps
