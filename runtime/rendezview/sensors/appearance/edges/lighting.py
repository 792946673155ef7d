"""The brightness of each kind of surface of the target in a frame.

The brightness of a diffuse surface is its albedo times ``sun max(0, n · s) + around``, with
strengths of the Sun and of uniform light from all around. The direction s and the two strengths
are fitted to the grey levels beside the contour points of a pose that is nearly right; a known
direction is used as it is. Cast shadows and glints are outliers of this fit.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, quantile
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.predicted import NX, NY, U, V
from rendezview.sensors.appearance.model.contours import OUTLINE, REACH_RADII, SURFACES, start_radii

Kinds = npt.NDArray[np.uint8]
Starts = npt.NDArray[np.int8]

_SUNS = np.ascontiguousarray(Geodesic.of_order(1).nodes)  # Source: by construction, 42 directions
# Source: by construction, half the spacing of those directions, halved twice
_HALVINGS_RAD = np.deg2rad(np.array([18.0, 9.0, 4.5]))  # rad; steps from one of those directions
# px; samples keep this distance from the edge, whose blur reaches so far. Source: by construction,
# two σ of blur_px
_BLUR_PX = 1.8
# px; and this distance from the next surface. Source: by construction, half a pixel
_BESIDE_PX = 0.5
_SAMPLES_EACH = 3  # of each surface of an edge profile. Source: by construction, a bound of time
_LEAST_SAMPLES, _MOST_SAMPLES = 40, 300
# One sample in three gives the rough direction of the Sun. Source: by construction, a bound of time
_COARSELY = 3
# Of the level of the bright samples: what diffuse shading leaves unexplained. Source: by hand,
# seeds of docs/notes/refinement.md
TOLERANCE = 0.1
# Of the levels: that of the bright samples. Source: by hand, seeds of docs/notes/refinement.md
BRIGHT_PERCENTILE = 80
# Least cosine between the Sun and the direction to the camera. Source: by construction, phase
# angles to 107°
BEHIND = -0.3
# Of weighted least squares, where many directions are compared. Source: by construction, a bound of
# time
ROUNDS = 3
_CANDIDATES = 6  # directions around the best one, for each step. Source: by construction, a hexagon
# Component of a unit vector beyond which another axis is crossed with it.
_KEEP = 0.7  # Source: by construction, any axis not along it


@njit(cache=True, nogil=True, error_model="numpy")
def fit_light(
    image: Picture, edges: Array, count: int, kind: Kinds, strip: Kinds, start: Starts,
    palette: npt.NDArray[np.float32], rotation: Array, centre: Array, scale: float, frame: Array,
    sun: Array, shade: Array,
) -> float:  # fmt: skip
    """Fit the light of a frame; fills ``shade`` (K,), grey levels above black of every kind.

    Args:
        edges: (N, COLUMNS) where ``measure_edges`` has put the contour points, ``count`` of them.
        kind, strip, start: of the nearest view, as ``Contours`` has them.
        palette: (K, 4) normals and albedo.
        rotation, centre: of the pose, camera frame.
        scale: pixels of the target's radius.
        frame: (6,) as in ``Sky.vector``.
        sun: (3,) gets the direction to the Sun, camera frame; unless it is zero, the search
            starts from it.

    Returns:
        Share of the samples that the light explains, 0 … 1; −1 (and ``shade`` all 0) where too
        few samples lie in the frame.
    """
    shade[:] = 0.0
    most = count * SURFACES * _SAMPLES_EACH
    levels, which = np.empty(most), np.empty(most, dtype=np.int64)
    black = frame[1] if frame[2] > 0.0 else 0.0
    found = sample_surfaces(image, edges, count, kind, strip, start, scale, black, levels, which)
    if found < _LEAST_SAMPLES:
        return -1.0
    every = 1 + found // _MOST_SAMPLES
    kept = (found + every - 1) // every
    for k in range(kept):
        levels[k], which[k] = levels[k * every], which[k * every]
    levels, which = levels[:kept], which[:kept]
    away, range_m = np.empty(3), np.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    for a in range(3):
        away[a] = centre[a] / range_m
    normals = facing_normals(palette, rotation, away)
    tolerance = TOLERANCE * quantile(levels, 0.01 * BRIGHT_PERCENTILE) + frame[0]
    known = frame[3] != 0.0 or frame[4] != 0.0 or frame[5] != 0.0
    if known:
        copy_into(frame[3:6], sun)
    strengths = np.empty(2)
    cost = search_sun(levels, which, normals, palette, away, tolerance, known, strengths, sun)
    for e in range(1, len(shade)):
        n = normals[e]
        facing = max(0.0, n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2])
        shade[e] = max(0.0, palette[e, 3] * (strengths[0] * facing + strengths[1]))
    return 1.0 - cost / len(levels)


@njit(cache=True, nogil=True, error_model="numpy")
def sample_surfaces(
    image: Picture, edges: Array, count: int, kind: Kinds, strip: Kinds, start: Starts,
    scale: float, black: float, levels: Array, which: npt.NDArray[np.int64],
) -> int:  # fmt: skip
    """Grey levels above black of the surfaces beside the contour points; how many.

    ``levels`` gets them, ``which`` the kind of surface of each; see ``fit_light``.
    """
    height, width = image.shape
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
                if abs(inside) < _BLUR_PX:
                    continue
                column = int(edges[j, U] - inside * edges[j, NX] + 0.5)
                row = int(edges[j, V] - inside * edges[j, NY] + 0.5)
                if 0 <= column < width and 0 <= row < height:
                    levels[found], which[found] = image[row, column] - black, strip[j, k]
                    found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def facing_normals(palette: npt.NDArray[np.float32], rotation: Array, away: Array) -> Array:
    """(K, 3) normals of the kinds of surface in the camera frame, on the side of the camera.

    ``away`` (3,) points from the camera to the target.
    """
    normals = np.empty((palette.shape[0], 3))
    for e in range(palette.shape[0]):
        for a in range(3):
            normals[e, a] = (
                rotation[a, 0] * palette[e, 0]
                + rotation[a, 1] * palette[e, 1]
                + rotation[a, 2] * palette[e, 2]
            )
    for e in range(len(normals)):
        n = normals[e]
        if n[0] * away[0] + n[1] * away[1] + n[2] * away[2] > 0.0:
            n[0], n[1], n[2] = -n[0], -n[1], -n[2]
    return normals


@njit(cache=True, nogil=True, error_model="numpy")
def search_sun(
    levels: Array, which: npt.NDArray[np.int64], normals: Array,
    palette: npt.NDArray[np.float32], away: Array, tolerance: float, known: bool,
    strengths: Array, sun: Array,
) -> float:  # fmt: skip
    """The direction of the Sun that explains the levels best, into ``sun`` (3,); its misfit.

    It starts from ``sun``, or, where that is zero, from the best of 42 directions, and stays there
    where it is ``known``. ``strengths`` (2,) are of ``light_strengths``.
    """
    count = (len(levels) + _COARSELY - 1) // _COARSELY
    some, of = np.empty(count), np.empty(count, dtype=np.int64)
    for k in range(count):
        some[k], of[k] = levels[k * _COARSELY], which[k * _COARSELY]
    tried, found = np.empty(3), np.empty(2)
    axes = np.zeros((2, 3))  # two unit vectors across the Sun
    best, angle = np.inf, 0.0
    dark = sun[0] == 0.0 and sun[1] == 0.0 and sun[2] == 0.0
    if dark:
        sun[0], sun[1], sun[2] = -away[0], -away[1], -away[2]
    # All of 42, coarsely; then the best of them; then directions ever nearer to the best.
    # ``_misfit`` stands here once, as every call is a copy of it.
    for step in range(-2 if dark else -1, 0 if known else len(_HALVINGS_RAD)):
        tries = 1
        if step == -2:
            tries = len(_SUNS)
        elif step == -1:
            best = np.inf
        else:
            tries, angle = _CANDIDATES, _HALVINGS_RAD[step]
            _across_into(sun, axes)
        ahead, aside = np.cos(angle), np.sin(angle)
        x, y, z = sun[0], sun[1], sun[2]
        for k in range(tries):
            if step == -2:
                tried[0], tried[1], tried[2] = _SUNS[k, 0], _SUNS[k, 1], _SUNS[k, 2]
                if -(tried[0] * away[0] + tried[1] * away[1] + tried[2] * away[2]) <= BEHIND:
                    continue
            else:
                c, s = aside * np.cos(k * np.pi / 3.0), aside * np.sin(k * np.pi / 3.0)
                tried[0] = ahead * x + c * axes[0, 0] + s * axes[1, 0]
                tried[1] = ahead * y + c * axes[0, 1] + s * axes[1, 1]
                tried[2] = ahead * z + c * axes[0, 2] + s * axes[1, 2]
            cost = _misfit(
                some if step == -2 else levels, of if step == -2 else which, normals, palette,
                tried, tolerance, found,
            )  # fmt: skip
            if cost < best:
                best = cost
                copy_into(tried, sun)
                copy_into(found, strengths)
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _across_into(sun: Array, axes: Array) -> None:
    """Two unit vectors (2, 3) across another: it × the x axis or the y axis, and it × that."""
    x, y, z = sun[0], sun[1], sun[2]
    p, q, r = (0.0, z, -y) if abs(x) < _KEEP else (-z, 0.0, x)
    length = np.sqrt(p * p + q * q + r * r)
    p, q, r = p / length, q / length, r / length
    axes[0, 0], axes[0, 1], axes[0, 2] = p, q, r
    axes[1, 0], axes[1, 1], axes[1, 2] = y * r - z * q, z * p - x * r, x * q - y * p


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _misfit(
    levels: Array, which: npt.NDArray[np.int64], normals: Array,
    palette: npt.NDArray[np.float32], sun: Array, tolerance: float, strengths: Array,
) -> float:  # fmt: skip
    """Robust misfit of one Sun, by kinds; see ``light_strengths``."""
    kinds = normals.shape[0]
    facing = np.empty(kinds)
    for e in range(kinds):
        cosine = normals[e, 0] * sun[0] + normals[e, 1] * sun[1] + normals[e, 2] * sun[2]
        facing[e] = palette[e, 3] * max(0.0, cosine)
    sunlit, albedo = np.empty(len(levels)), np.empty(len(levels))
    for i in range(len(levels)):
        sunlit[i], albedo[i] = facing[which[i]], palette[which[i], 3]
    rounds = int(np.int64(ROUNDS))  # as a literal, numba would compile a copy for it
    return light_strengths(levels, sunlit, albedo, tolerance, np.inf, strengths, rounds, False)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def light_strengths(
    levels: Array, sunlit: Array, albedo: Array, tolerance: float, white: float,
    strengths: Array, rounds: int, sun_alone: bool,
) -> float:  # fmt: skip
    """Robust misfit of the best strengths (2,) of one Sun and of the light all around.

    It starts from the bright samples: shadows only darken.

    Args:
        levels: (N,) grey levels above black.
        lit: (N,) albedo times the cosine to the Sun, 0 where it does not reach.
        albedo: (N,).
        tolerance: grey levels beyond which a level is an outlier.
        white: grey levels above black; from there on a level is a lower bound (Tobin 1958).
        strengths: (2,) gets the grey levels of albedo 1 in full sun, and around.
        rounds: of weighted least squares.
        sun_alone: start without the light all around. Where one face fills the picture there are
            two optima: it is lit from all around, its shadow an outlier, or by the Sun alone.
    """
    a, b = 0.0, 0.0
    inverse = 1.0 / (tolerance * tolerance)
    cost = 0.0
    for step in range(rounds + 1):
        aa, ab, bb, ca, cb, cost = 1e-9, 0.0, 1e-9, 0.0, 0.0, 0.0
        for i in range(levels.shape[0]):
            x, y = sunlit[i], albedo[i]
            weight = max(0.0, levels[i])  # at first
            if step > 0:
                r = levels[i] - a * x - b * y
                if r < 0.0 and levels[i] >= white:
                    continue
                weight = 1.0 / (1.0 + r * r * inverse)
                cost += 1.0 - weight
                weight *= weight
            aa += weight * x * x
            ab += weight * x * y
            bb += weight * y * y
            ca += weight * x * levels[i]
            cb += weight * y * levels[i]
        if step == rounds:
            break
        bb *= 1.001
        determinant = aa * bb - ab * ab
        a, b = (ca * bb - cb * ab) / determinant, (cb * aa - ca * ab) / determinant
        if b < 0.0 or (sun_alone and step == 0):
            a, b = ca / aa, 0.0
        elif a < 0.0:
            a, b = 0.0, cb / bb
    strengths[0], strengths[1] = a, b
    return cost
