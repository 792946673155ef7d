"""Directed chains of edge points: Canny's pixels, placed along the gradient, linked by direction.

A chain runs with the bright side on its right as the picture is seen, so that it turns one way
along a convex outline, and two edges that touch are not joined against their gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

Grey = npt.NDArray[np.uint8]  # (H, W)
Gradient = npt.NDArray[np.int16]  # (H, W), Sobel's sum: 8 × grey levels a pixel
Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

BLUR_PX = 1.0  # σ of the smoothing before the gradient
_KERNEL = (5, 5)
SOBEL = 8.0  # of Sobel's weights, to grey levels a pixel
_GRADIENT_SHARE = 1.05  # noise of one Sobel component over the pixels' σ, after the smoothing


@dataclass(frozen=True, slots=True, eq=False)
class EdgeMap:
    """Gradients of a frame and its edge pixels."""

    dx: Gradient
    dy: Gradient
    edges: Grey  # 255 where an edge is
    noise_grey: float  # σ of a pixel
    low: float  # least gradient of an edge, Sobel units


@njit(cache=True, nogil=True)
def noise_of(image: Grey) -> float:
    """Noise of a frame (one σ): the smaller half of second differences on a sparse grid."""
    height, width = image.shape
    step = max(1, height // 48)
    counts = np.zeros(512, dtype=np.int64)
    total = 0
    for row in range(step // 2, height, step):
        for column in range(1, width - 1, 7):
            a = int(image[row, column - 1]) - 2 * int(image[row, column])
            counts[min(511, abs(a + int(image[row, column + 1])))] += 1
            total += 1
    seen, mean = 0, 0.0
    for value in range(512):
        take = min(counts[value], total // 2 - seen)
        seen += take
        mean += take * value
        if seen >= total // 2:
            break
    # The mean of the smaller half of |N(0, 1)| is 0.3247; second differences have σ √6.
    return float(mean / max(seen, 1) / (0.3247 * np.sqrt(6.0)))


def find_edges(image: Grey, least_contrast_grey: float, sigmas: float) -> EdgeMap:
    """Edge pixels whose gradient stands out of the noise.

    Args:
        image: (H, W) uint8.
        least_contrast_grey: weakest step that is still an edge.
        sigmas: how far the gradient must stand out of its noise.
    """
    noise = noise_of(image)
    smooth = cv2.GaussianBlur(image, _KERNEL, BLUR_PX)
    dx, dy = cv2.spatialGradient(smooth)
    # A step of contrast c, blurred to σ ≈ 1.5 px, has the slope 0.27 c.
    high = max(0.27 * SOBEL * least_contrast_grey, sigmas * _GRADIENT_SHARE * noise)
    low = 0.6 * high
    edges = cv2.Canny(dx, dy, low, high, L2gradient=True)
    return EdgeMap(dx, dy, np.asarray(edges, np.uint8), noise, low)  # type: ignore[arg-type]


@njit(cache=True, nogil=True)
def link(dx, dy, edges):  # type: ignore[no-untyped-def]
    """Edge pixels as chains.

    Returns:
        points: (N, 4) x, y (px, sub-pixel), unit gradient x, y, in the order of the chains;
        starts: (C + 1,) where each chain begins; closed: (C,) whether it ends where it began.
    """
    height, width = edges.shape
    number = np.zeros((height, width), dtype=np.int32)
    total = 0
    for row in range(2, height - 2):
        line = edges[row]
        for column in range(2, width - 2):
            if line[column] != 0:
                total += 1
                number[row, column] = total
    found = np.empty((total, 4))
    k = 0
    place = np.empty((total, 2), dtype=np.int32)
    for row in range(2, height - 2):
        line = number[row]
        for column in range(2, width - 2):
            if line[column] == 0:
                continue
            place[k, 0], place[k, 1] = column, row
            gx, gy = float(dx[row, column]), float(dy[row, column])
            size = np.sqrt(gx * gx + gy * gy) + 1e-9
            ux, uy = gx / size, gy / size
            # The gradient's size one step to either side along the gradient, between two pixels.
            if abs(ux) >= abs(uy):
                step = 1 if ux > 0.0 else -1
                t = abs(uy / ux)
                side = 1 if uy > 0.0 else -1
                a = _size(dx, dy, row, column + step) * (1.0 - t)
                a += _size(dx, dy, row + side, column + step) * t
                b = _size(dx, dy, row, column - step) * (1.0 - t)
                b += _size(dx, dy, row - side, column - step) * t
                far = 1.0 / abs(ux)
            else:
                step = 1 if uy > 0.0 else -1
                t = abs(ux / uy)
                side = 1 if ux > 0.0 else -1
                a = _size(dx, dy, row + step, column) * (1.0 - t)
                a += _size(dx, dy, row + step, column + side) * t
                b = _size(dx, dy, row - step, column) * (1.0 - t)
                b += _size(dx, dy, row - step, column - side) * t
                far = 1.0 / abs(uy)
            bend = a + b - 2.0 * size
            shift = 0.5 * (b - a) / bend if bend < -1e-9 else 0.0
            shift = min(max(shift, -0.6), 0.6) * far
            found[k, 0], found[k, 1] = column + shift * ux, row + shift * uy
            found[k, 2], found[k, 3] = ux, uy
            k += 1
    follower = np.full(total, -1, dtype=np.int32)
    leader = np.full(total, -1, dtype=np.int32)
    quality = np.zeros(total)
    for i in range(total):
        ux, uy = found[i, 2], found[i, 3]
        tx, ty = -uy, ux
        best, at = 0.0, -1
        for reach in range(1, 3):
            for down in range(-reach, reach + 1):
                for right in range(-reach, reach + 1):
                    if max(abs(down), abs(right)) != reach:
                        continue
                    j = number[place[i, 1] + down, place[i, 0] + right] - 1
                    if j < 0:
                        continue
                    ahead_x, ahead_y = found[j, 0] - found[i, 0], found[j, 1] - found[i, 1]
                    ahead = ahead_x * tx + ahead_y * ty
                    if ahead <= 0.2:
                        continue
                    alike = ux * found[j, 2] + uy * found[j, 3]
                    if alike < 0.6:
                        continue
                    far = np.sqrt(ahead_x * ahead_x + ahead_y * ahead_y)
                    value = alike + ahead / far - 0.15 * far
                    if value > best:
                        best, at = value, j
            if at >= 0:
                break
        if at >= 0:
            if leader[at] >= 0:
                if quality[at] >= best:
                    continue
                follower[leader[at]] = -1
            leader[at] = i
            quality[at] = best
            follower[i] = at
    points = np.empty((total, 4))
    starts = np.empty(total + 1, dtype=np.int32)
    closed = np.zeros(total, dtype=np.bool_)
    chains, filled = 0, 0
    used = np.zeros(total, dtype=np.bool_)
    for ring in range(2):  # first what has a beginning, then what is closed
        for i in range(total):
            if used[i] or (ring == 0 and leader[i] >= 0):
                continue
            starts[chains] = filled
            j = i
            while j >= 0 and not used[j]:
                used[j] = True
                for c in range(4):
                    points[filled, c] = found[j, c]
                filled += 1
                j = follower[j]
            if filled - starts[chains] < 8:  # too short to bend
                filled = starts[chains]
                continue
            closed[chains] = ring == 1
            chains += 1
    starts[chains] = filled
    return points[:filled], starts[: chains + 1], closed[:chains]


@njit(cache=True, nogil=True, inline="always")
def _size(dx, dy, row, column):  # type: ignore[no-untyped-def]
    a, b = float(dx[row, column]), float(dy[row, column])
    return np.sqrt(a * a + b * b)
