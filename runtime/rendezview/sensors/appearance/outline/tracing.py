"""From the border pixels of a silhouette to its outline, and from the outline to numbers.

An outline is a closed polygon of rays ``(x, y, 1)`` in the camera frame. Its *vector
area* ``½ ∮ r × dr`` over unit rays r is ``∫ r dΩ`` over the silhouette: the direction is
the silhouette's centroid on the sphere of directions, the length its area. Neither
depends on where in the picture the target stands, so an off-boresight target needs no
other correction than turning the rays to the centroid: the pure rotation asked for by a
camera that does not look straight at its target.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

# Neighbours of a pixel, clockwise on the screen from East (x right, y down).
_DX = np.array([1, 1, 0, -1, -1, -1, 0, 1])
_DY = np.array([0, 1, 1, 1, 0, -1, -1, -1])
_DIRECTION_OF_STEP = np.array([[5, 6, 7], [4, -1, 0], [3, 2, 1]])  # [dy + 1, dx + 1]


@njit(cache=True, nogil=True)
def crack_outline(
    border: npt.NDArray[np.int32],
    grey: npt.NDArray[np.uint8],
    sky: float,
    contrast: float,
    reach: int,
) -> Array:
    """Sub-pixel outline between the border pixels of a silhouette and their outer neighbours.

    Each side of a border pixel that faces the outside gives one point. Where ``grey`` is
    a picture the point lies where the grey level, looked at along the side's normal,
    falls through the middle between the sky's level and the target's level just inside;
    where ``grey`` is empty (a drawn silhouette) it lies half a pixel from the centre of
    the border pixel, so that a straight slanted edge gives a straight row of points.

    Args:
        border: (N, 2) x, y of the 8-connected outer border as ``cv2.findContours`` with
            ``CHAIN_APPROX_NONE`` gives it (counter-clockwise on the screen).
        grey: (H, W) the frame, or (0, 0).
        sky: grey level of the background.
        contrast: grey levels above the sky that the target must have just inside; a side
            where it has not, such as one beyond a corner, gives no point.
        reach: how far inside the border the target's own level is looked for, pixels. Too
            far takes the bright body behind a dim panel for the panel's level.

    Returns:
        (M, 2) points in pixels, pixel (0, 0) being the centre of the top-left pixel.
    """
    n = border.shape[0]
    points = np.empty((4 * n + 4, 2))
    count = 0
    drawn = grey.size == 0
    for i in range(n):
        x, y = border[i, 0], border[i, 1]
        first, steps = 6, 8  # of a single pixel
        if n > 1:
            before, after = i - 1 if i > 0 else n - 1, i + 1 if i + 1 < n else 0
            back = _DIRECTION_OF_STEP[border[before, 1] - y + 1, border[before, 0] - x + 1]
            ahead = _DIRECTION_OF_STEP[border[after, 1] - y + 1, border[after, 0] - x + 1]
            first = (back + 7) & 7
            steps = (first - ahead) & 7 if back != ahead else 7
        for k in range(first & 1, steps, 2):  # the sides; corners give no point
            direction = (first - k) & 7
            dx, dy = _DX[direction], _DY[direction]
            shift = 0.5 if drawn else _edge_shift(grey, x, y, dx, dy, sky, contrast, reach)
            if not np.isnan(shift):
                points[count, 0] = x + shift * dx
                points[count, 1] = y + shift * dy
                count += 1
    return points[:count]


@njit(cache=True, nogil=True)
def _edge_shift(
    grey: npt.NDArray[np.uint8],
    x: int,
    y: int,
    dx: int,
    dy: int,
    sky: float,
    contrast: float,
    reach: int,
) -> float:
    """Distance along (dx, dy) from pixel (x, y) to the middle grey level of the edge; or NaN."""
    height, width = grey.shape
    inside = float(grey[y, x])
    best = inside
    for step in range(1, reach + 1):
        xi, yi = x - step * dx, y - step * dy
        if 0 <= xi < width and 0 <= yi < height:
            best = max(best, float(grey[yi, xi]))
    if best < sky + contrast:
        return np.nan
    level = 0.5 * (sky + best)
    xo, yo = x + dx, y + dy
    if not (0 <= xo < width and 0 <= yo < height):
        return 0.5
    outer, inner = float(grey[yo, xo]), inside
    position = 0.0  # of the inner pixel along the normal
    for _ in range(reach + 1):
        if inner >= level:
            if outer >= level:
                return position + 0.99
            return position + (inner - level) / (inner - outer)
        outer = inner
        position -= 1.0
        xi, yi = x + int(position) * dx, y + int(position) * dy
        if not (0 <= xi < width and 0 <= yi < height):
            break
        inner = float(grey[yi, xi])
    return np.nan


@njit(cache=True, nogil=True)
def vector_area(rays: Array) -> Array:
    """``½ ∮ r × dr`` of a closed polygon of rays (M, 3) of any length; steradians, (3,).

    Counter-clockwise on the screen (x right, y down) gives −z for a camera that looks
    along +z, so the sign is turned: the result points to the silhouette.
    """
    total = np.zeros(3)
    m = rays.shape[0]
    if m == 0:
        return total
    a = rays[m - 1] / np.sqrt(np.sum(rays[m - 1] ** 2))
    for i in range(m):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        bx, by, bz = x * scale, y * scale, z * scale
        total[0] -= 0.5 * (a[1] * bz - a[2] * by)
        total[1] -= 0.5 * (a[2] * bx - a[0] * bz)
        total[2] -= 0.5 * (a[0] * by - a[1] * bx)
        a[0], a[1], a[2] = bx, by, bz
    return total


@njit(cache=True, nogil=True)
def radial_maxima(rays: Array, centred_from_camera: Array, spokes: Array, maxima: Array) -> None:
    """Distance to the outermost edge of one outline in each bin, kept where it is larger.

    Bin k looks along the angle ``2πk/N`` from East, counter-clockwise as seen on the
    screen; its reading is the farthest crossing of that ray with the outline, in the
    plane at unit distance across the boresight of the centred camera (Cleghorn &
    Sternberg, figure 2).

    Args:
        rays: (M, 3) closed polygon in the camera frame.
        centred_from_camera: (3, 3) rotation that puts the centroid on the boresight.
        spokes: (N, 2) cosine and sine of each bin, see ``spokes_of``.
        maxima: (N,) the distances so far, changed in place.
    """
    m, bins = rays.shape[0], maxima.shape[0]
    if m == 0:
        return
    per_radian = bins / (2.0 * np.pi)
    q = centred_from_camera
    x0, y0, turn0 = 0.0, 0.0, 0.0
    for i in range(-1, m):
        k = m - 1 if i < 0 else i
        rx, ry, rz = rays[k, 0], rays[k, 1], rays[k, 2]
        z = q[2, 0] * rx + q[2, 1] * ry + q[2, 2] * rz
        if z <= 1e-9:
            return  # more than a right angle from the centroid: not a target's outline
        scale = 1.0 / z
        x1 = (q[0, 0] * rx + q[0, 1] * ry + q[0, 2] * rz) * scale
        y1 = -(q[1, 0] * rx + q[1, 1] * ry + q[1, 2] * rz) * scale  # up on the screen
        turn1 = _nearly_atan2(y1, x1) * per_radian
        if i >= 0:
            low, high = turn0, turn1
            if high - low > 0.5 * bins:
                low += bins
            elif low - high > 0.5 * bins:
                high += bins
            if low > high:
                low, high = high, low
            first = int(np.ceil(low))
            last = int(np.floor(high))
            if first <= last:
                dx, dy = x1 - x0, y1 - y0
                cross = x0 * dy - y0 * dx
                farther = np.sqrt(max(x0 * x0 + y0 * y0, x1 * x1 + y1 * y1))
                for b in range(first, last + 1):
                    k = b % bins
                    across = spokes[k, 0] * dy - spokes[k, 1] * dx
                    distance = farther
                    if abs(across) > 1e-300:  # of a segment along the ray the quotient is rounding
                        distance = min(farther, cross / across)
                    if distance > maxima[k]:
                        maxima[k] = distance
        x0, y0, turn0 = x1, y1, turn1


@lru_cache(maxsize=16)
def spokes_of(bins: int) -> Array:
    """(N, 2) cosine and sine of the angle at which each of N bins looks."""
    angles = 2.0 * np.pi * np.arange(bins) / bins
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    spokes.setflags(write=False)
    return spokes


@njit(cache=True, nogil=True)
def _nearly_atan2(y: float, x: float) -> float:
    """atan2 to 1e-5 rad, which only decides the bins that a segment is asked about.

    Minimax polynomial of odd degree 9 for arctan on [0, 1] (Abramowitz & Stegun 4.4.49,
    coefficients there for |error| ≤ 1e-5).
    """
    ax, ay = abs(x), abs(y)
    large = max(ax, ay)
    if large == 0.0:
        return 0.0
    t = min(ax, ay) / large
    s = t * t
    angle = t * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))))
    if ay > ax:
        angle = 0.5 * np.pi - angle
    if x < 0.0:
        angle = np.pi - angle
    return -angle if y < 0.0 else angle
