"""Strips of surfaces beside an edge: as they are seen from a pose, and fitted to a profile.

The model keeps what lies beside an edge as one of its views shows it, and how deep it lies. Seen
from elsewhere a surface begins where that place is seen, or is hidden.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.geometry.normal_table import DENSITY, PER_UNIT, PHI, REACH, normal_cdf
from rendezview.sensors.appearance.edges.contours import SURFACES

_INSIDE_PX, _OUTSIDE_PX = 3.2, 2.7  # of an edge: what its strip is fitted to
_STEP_GREY = 5.0  # of brightness within a strip; smaller ones are left out
_GAIN_SPREAD = 0.5  # of the brightness that is expected
_TILT_SPREAD = 0.1  # a pixel, of the strip's contrast
_MODEL_GREY = 3.0  # what the strip leaves unexplained anyway


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
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


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
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


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def begins_at(x, y, z, inside, deeper, drawn_eye, drawn, rotation, centre):  # type: ignore[no-untyped-def]
    """Where a surface beside the point (x, y, z) is seen to begin, normalised (x, y).

    In the model's view it begins ``inside`` metres inwards of the point and ``deeper`` metres
    beyond it.

    Args:
        drawn_eye: (3,) the camera of that view, target axes at the view centre.
        drawn: (6,) of ``across`` from there.
        rotation, centre: of the pose, camera frame.
    """
    ax, ay, az = x - drawn_eye[0], y - drawn_eye[1], z - drawn_eye[2]
    more = 1.0 + deeper / np.sqrt(ax * ax + ay * ay + az * az)
    bx = drawn_eye[0] + more * (ax - inside * drawn[3])
    by = drawn_eye[1] + more * (ay - inside * drawn[4])
    bz = drawn_eye[2] + more * (az - inside * drawn[5])
    u = rotation[0, 0] * bx + rotation[0, 1] * by + rotation[0, 2] * bz + centre[0]
    v = rotation[1, 0] * bx + rotation[1, 1] * by + rotation[1, 2] * bz + centre[1]
    w = rotation[2, 0] * bx + rotation[2, 1] * by + rotation[2, 2] * bz + centre[2]
    inverse = 1.0 / w
    return u * inverse, v * inverse


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def in_shadow(wide, rise, sunward, drawn, away):  # type: ignore[no-untyped-def]
    """Whether what rises at the inner end of a surface casts its shadow over all of it.

    Args:
        wide, rise: of the surface and of what stands there, any unit.
        sunward: (3,) to the Sun, or 0.
        drawn: (6,) of ``across``, and ``away``: (3,) unit, from the camera of the model's view.
    """
    over = -(sunward[0] * drawn[3] + sunward[1] * drawn[4] + sunward[2] * drawn[5])
    up = -(sunward[0] * away[0] + sunward[1] * away[1] + sunward[2] * away[2])
    return rise > 0.0 and over > 0.0 and rise * over > wide * max(up, 0.0)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def steps_of(outline, strip, shade, places, shaded, depths, levels):  # type: ignore[no-untyped-def]
    """Depths and steps in brightness of a strip; how many.

    A surface that would begin where it has ended is hidden by the next.

    Args:
        outline: whether it is an outline's; of an inner edge the first level is left out: it is
            the background.
        strip: (SURFACES,) kinds, from outside to inside.
        shade: (K,) brightness of each kind.
        places: (SURFACES,) where each begins, pixels inwards; an inner edge's first: far outside.
        shaded: whether the first lies in the shadow of what rises at its end.
        depths, levels: (SURFACES,) get the steps.
    """
    steps, before = 0, 0.0
    if not outline:
        before = shade[strip[0]]
    for k in range(0 if outline else 1, SURFACES):
        if k + 1 < SURFACES and places[k + 1] <= places[k]:
            continue
        level = 0.0 if k == 0 and shaded else shade[strip[k]]
        if (outline and steps == 0) or abs(level - before) > _STEP_GREY:
            depths[steps], levels[steps] = places[k], level - before
            steps += 1
            before = level
    return steps
