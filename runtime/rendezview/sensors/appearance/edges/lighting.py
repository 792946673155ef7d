"""How bright each kind of surface of the target is in a frame.

A matt surface under the Sun and some light from all around is as bright as its albedo times
``sun max(0, n · s) + around``. The direction s and the two strengths are fitted to the grey levels
of the frame beside the contour points of a pose that is nearly right; a direction that is known is
taken. Cast shadows and glints lie off such a fit and count as outliers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.geometry.geodesic import Geodesic
from rendezview.sensors.appearance.edges.contours import OUTLINE, REACH_RADII, SURFACES, start_radii
from rendezview.sensors.appearance.edges.edge_search import NX, NY, U, V

_SUNS = np.ascontiguousarray(Geodesic.of_order(1).nodes)
_HALVINGS = np.deg2rad(np.array([18.0, 9.0, 4.5]))  # of the way between those directions
_BLURRED_PX = 1.8  # nearer to an edge its blur reaches
_BESIDE_PX = 0.5  # of the next surface of a strip: like it, as a rule
_SAMPLES_EACH = 3  # surface of a strip
_LEAST_SAMPLES, _MOST_SAMPLES = 40, 300
_COARSELY = 3  # every so many-th sample says roughly where the Sun is
_TOLERANCE = 0.1  # of the bright samples' level: what shading leaves unexplained
_BEHIND = -0.3  # cosine to the camera of the last Sun that is tried


@njit(cache=True, nogil=True)
def light(  # type: ignore[no-untyped-def]
    image, edges, count, kind, strip, start, palette, rotation, centre, scale, frame, sun, shade
):
    """Fit the light of a frame; fills ``shade`` (K,), grey levels above black of every kind.

    Args:
        edges: (N, COLUMNS) where ``measure_edges`` has put the contour points, ``count`` of them.
        kind, strip, start: of the view that is seen, as ``Contours`` has them.
        palette: (K, 4) normals and albedo.
        rotation, centre: of the pose, camera frame.
        scale: pixels of the target's radius.
        frame: (6,) as in ``Sky.vector``.
        sun: (3,) gets the direction to the Sun, camera frame; where it is not zero, it is near.

    Returns:
        Share of the samples that the light explains, 0 … 1; −1 (and ``shade`` all 0) where too
        few samples lie in the frame.
    """
    height, width = image.shape
    noise, black = frame[0], frame[1] if frame[2] > 0.0 else 0.0
    shade[:] = 0.0
    most = count * SURFACES * _SAMPLES_EACH
    levels, which = np.empty(most), np.empty(most, dtype=np.int64)
    found = 0
    for j in range(count):
        if edges[j, NX] == 0.0 and edges[j, NY] == 0.0:
            continue
        near = 0.0 if kind[j] == OUTLINE else -REACH_RADII * scale
        for k in range(SURFACES):
            far = REACH_RADII * scale
            if k + 1 < SURFACES:
                far = min(far, start_radii(start[j, k, 0]) * scale)
            middle, half = 0.5 * (near + far), max(0.0, 0.5 * (far - near) - _BESIDE_PX)
            near = far
            if strip[j, k] == 0 or half == 0.0:
                continue
            for place in range(-1, 2):
                inside = middle + place * half
                if abs(inside) < _BLURRED_PX:
                    continue
                column = int(edges[j, U] - inside * edges[j, NX] + 0.5)
                row = int(edges[j, V] - inside * edges[j, NY] + 0.5)
                if 0 <= column < width and 0 <= row < height:
                    levels[found], which[found] = image[row, column] - black, strip[j, k]
                    found += 1
    if found < _LEAST_SAMPLES:
        return -1.0
    every = 1 + found // _MOST_SAMPLES
    levels, which = levels[:found:every].copy(), which[:found:every].copy()
    normals = np.empty((palette.shape[0], 3))
    for e in range(palette.shape[0]):
        for a in range(3):
            normals[e, a] = (
                rotation[a, 0] * palette[e, 0]
                + rotation[a, 1] * palette[e, 1]
                + rotation[a, 2] * palette[e, 2]
            )
    away = centre / np.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    for e in range(len(normals)):
        n = normals[e]
        if n[0] * away[0] + n[1] * away[1] + n[2] * away[2] > 0.0:  # the side that is seen
            n[0], n[1], n[2] = -n[0], -n[1], -n[2]
    tolerance = _TOLERANCE * np.percentile(levels, 80) + noise
    strengths = np.empty(2)
    known = frame[3] != 0.0 or frame[4] != 0.0 or frame[5] != 0.0
    if known:
        sun[:] = frame[3:6]
    else:
        if sun[0] == 0.0 and sun[1] == 0.0 and sun[2] == 0.0:
            some, of = levels[::_COARSELY].copy(), which[::_COARSELY].copy()
            best = np.inf
            sun[:] = -away
            for k in range(len(_SUNS)):
                if -np.dot(_SUNS[k], away) > _BEHIND:
                    cost = _misfit(some, of, normals, palette, _SUNS[k], tolerance, strengths)
                    if cost < best:
                        best = cost
                        sun[:] = _SUNS[k]
        best = _misfit(levels, which, normals, palette, sun, tolerance, strengths)
        for step in _HALVINGS:
            across = np.cross(sun, np.array([1.0, 0.0, 0.0]) if abs(sun[0]) < 0.7 else
                              np.array([0.0, 1.0, 0.0]))  # fmt: skip
            across /= np.sqrt(np.dot(across, across))
            other = np.cross(sun, across)
            middle = sun.copy()
            for k in range(6):
                c, s = np.cos(k * np.pi / 3.0), np.sin(k * np.pi / 3.0)
                tried = np.cos(step) * middle + np.sin(step) * (c * across + s * other)
                cost = _misfit(levels, which, normals, palette, tried, tolerance, strengths)
                if cost < best:
                    best = cost
                    sun[:] = tried
    cost = _misfit(levels, which, normals, palette, sun, tolerance, strengths)
    for e in range(1, len(shade)):
        n = normals[e]
        facing = max(0.0, n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2])
        shade[e] = max(0.0, palette[e, 3] * (strengths[0] * facing + strengths[1]))
    return 1.0 - cost / len(levels)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def _misfit(levels, which, normals, palette, sun, tolerance, strengths):  # type: ignore[no-untyped-def]
    """Robust misfit of one Sun, by kinds; see ``light_strengths``."""
    kinds = normals.shape[0]
    facing = np.empty(kinds)
    for e in range(kinds):
        cosine = normals[e, 0] * sun[0] + normals[e, 1] * sun[1] + normals[e, 2] * sun[2]
        facing[e] = palette[e, 3] * max(0.0, cosine)
    lit, albedo = np.empty(len(levels)), np.empty(len(levels))
    for i in range(len(levels)):
        lit[i], albedo[i] = facing[which[i]], palette[which[i], 3]
    return light_strengths(levels, lit, albedo, tolerance, strengths)


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def light_strengths(levels, lit, albedo, tolerance, strengths):  # type: ignore[no-untyped-def]
    """Robust misfit of the best strengths (2,) of one Sun and of the light all around.

    It starts from the bright samples: shadows only darken.

    Args:
        levels: (N,) grey levels above black.
        lit: (N,) albedo times the cosine to the Sun, 0 where it does not reach.
        albedo: (N,).
        tolerance: grey levels beyond which a level is an outlier.
        strengths: (2,) gets the grey levels of albedo 1 in full sun, and around.
    """
    a, b = 0.0, 0.0
    inverse = 1.0 / (tolerance * tolerance)
    cost = 0.0
    for step in range(4):
        aa, ab, bb, ca, cb, cost = 1e-9, 0.0, 1e-9, 0.0, 0.0, 0.0
        for i in range(levels.shape[0]):
            x, y = lit[i], albedo[i]
            weight = max(0.0, levels[i])  # at first
            if step > 0:
                r = levels[i] - a * x - b * y
                weight = 1.0 / (1.0 + r * r * inverse)
                cost += 1.0 - weight
                weight *= weight
            aa += weight * x * x
            ab += weight * x * y
            bb += weight * y * y
            ca += weight * x * levels[i]
            cb += weight * y * levels[i]
        if step == 3:
            break
        bb *= 1.001
        determinant = aa * bb - ab * ab
        a, b = (ca * bb - cb * ab) / determinant, (cb * aa - ca * ab) / determinant
        if b < 0.0:
            a, b = ca / aa, 0.0
        elif a < 0.0:
            a, b = 0.0, cb / bb
    strengths[0], strengths[1] = a, b
    return cost
