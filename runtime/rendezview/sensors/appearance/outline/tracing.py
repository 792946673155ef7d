"""Border pixels of a silhouette to sub-pixel outline points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

# Neighbours of a pixel, clockwise on the screen from East (x right, y down).
_DX = np.array([1, 1, 0, -1, -1, -1, 0, 1])  # px. Source: by construction
_DY = np.array([0, 1, 1, 1, 0, -1, -1, -1])  # px. Source: by construction
# Direction of a step, by [dy + 1, dx + 1]. Source: by construction
_DIRECTION_OF_STEP = np.array([[5, 6, 7], [4, -1, 0], [3, 2, 1]])


@njit(cache=True, nogil=True, error_model="numpy")
def crack_outline(
    border: npt.NDArray[np.int32],
    grey: npt.NDArray[np.uint8],
    sky: float,
    contrast: float,
    reach: int,
) -> Array:
    """Sub-pixel outline between the border pixels of a silhouette and their outer neighbours.

    Each side of a border pixel that faces the outside gives one point. In a frame the point
    lies on the normal of that side, where the grey level crosses the middle between the sky
    and the target just inside. In a drawn mask it lies half a pixel from the pixel's centre,
    so that a straight slanted edge gives a straight row of points.

    Args:
        border: (N, 2) x, y of the 8-connected outer border, counter-clockwise on the screen, as
            ``cv2.findContours`` with ``CHAIN_APPROX_NONE`` gives it.
        grey: (H, W) the frame; (0, 0) for a drawn mask.
        sky: grey level of the background.
        contrast: grey levels above the sky that the target must reach just inside; a side
            without that contrast, such as one beyond a corner, gives no point.
        reach: pixels inside the border in which the target's own level is looked for. A long
            reach takes the level of a bright body for that of the dim panel before it.

    Returns:
        (M, 2) points in pixels.
    """
    n = border.shape[0]
    points = np.empty((4 * n + 4, 2))
    count = 0
    drawn = grey.size == 0
    for i in range(n):
        x, y = border[i, 0], border[i, 1]
        first, steps = 6, 8  # a single pixel: all sides
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


@njit(cache=True, nogil=True, error_model="numpy")
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
    position = 0.0  # of the inner pixel, along the normal
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
