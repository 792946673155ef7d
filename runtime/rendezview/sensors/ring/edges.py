"""Directed chains of edge points: crests of the gradient, placed along it, linked by direction.

Crests are Canny's: pixels whose gradient is the largest across the edge. His hysteresis is not
used: two thresholds found no more rings than one.

A chain runs with the bright side on its right as the picture is seen, so that it turns one way
along a convex outline, and two edges that touch are not joined against their gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_matrix_into
from rendezview.io.grey_frame import grain

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]

Grey = npt.NDArray[np.uint8]  # (H, W)
Gradient = npt.NDArray[np.int16]  # (H, W), Sobel's sum: 8 × grey levels a pixel
Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

BLUR_PX = 1.0  # σ of the smoothing before the gradient. Source: by hand; see ring-accuracy
_KERNEL = (5, 5)  # px of that smoothing. Source: by construction, 2 σ to either side
SOBEL = (
    8.0  # Sobel units of a slope of 1 grey level a pixel. Source: by construction, Sobel's weights
)
_GRAIN_ROWS = 48  # rows on which the noise is measured. Source: by construction, a bound of time


@dataclass(frozen=True, slots=True, eq=False)
class EdgeMap:
    """Gradients of a frame, and from where on they are an edge."""

    dx: Gradient
    dy: Gradient
    noise_grey: float  # σ of a pixel
    least: float  # gradient of an edge pixel, Sobel units


def find_edges(image: Grey, least_contrast_grey: float, sigmas: float) -> EdgeMap:
    """Edge pixels whose gradient stands out of the noise.

    Args:
        image: (H, W) uint8.
        least_contrast_grey: weakest step that is still an edge.
        sigmas: how far the gradient must stand out of its noise.
    """
    noise = grain(image, _GRAIN_ROWS)
    smooth = cv2.GaussianBlur(image, _KERNEL, BLUR_PX)
    dx, dy = cv2.spatialGradient(smooth)
    # A step of contrast c, blurred to σ ≈ 1.5 px, has the slope 0.27 c.
    least = max(0.27 * SOBEL * least_contrast_grey, sigmas * _noise_of_sobel() * noise)
    return EdgeMap(dx, dy, noise, least)  # type: ignore[arg-type]


def _noise_of_sobel() -> float:
    """White noise of one Sobel component over the pixels' σ, after the smoothing: 1.17."""
    taps = cv2.getGaussianKernel(_KERNEL[0], BLUR_PX)[:, 0]
    along, across = (np.linalg.norm(np.convolve(taps, way)) for way in ((1, 2, 1), (1, 0, -1)))
    return float(along * across)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _powers(dx: Gradient, dy: Gradient, line: Floats) -> None:
    """Squared gradients of a row."""
    for column in range(line.shape[0]):
        a, b = np.float32(dx[column]), np.float32(dy[column])
        line[column] = a * a + b * b


@njit(cache=True, nogil=True, error_model="numpy")
def _crest(
    dx: Gradient, dy: Gradient, power: Floats, row: int, column: int, here: float, out: Array,
    k: int,
) -> bool:  # fmt: skip
    """Place x, y, direction and size of the crest at a pixel, into row k of ``out``."""
    gx, gy = np.float32(dx[row, column]), np.float32(dy[row, column])
    # Two neighbours on the gradient's line, each between two pixels.
    if abs(gx) >= abs(gy):
        step = 1 if gx > 0 else -1
        side = 1 if gy > 0 else -1
        t = abs(gy / gx)
        p00, p01 = power[row, column + step], power[row + side, column + step]
        p10, p11 = power[row, column - step], power[row - side, column - step]
    else:
        step = 1 if gy > 0 else -1
        side = 1 if gx > 0 else -1
        t = abs(gx / gy)
        p00, p01 = power[row + step, column], power[row + step, column + side]
        p10, p11 = power[row - step, column], power[row - step, column - side]
    rest = np.float32(1.0) - t
    if rest * p00 + t * p01 >= here or rest * p10 + t * p11 > here:
        return False
    size = np.sqrt(here)
    a = rest * np.sqrt(p00) + t * np.sqrt(p01)
    b = rest * np.sqrt(p10) + t * np.sqrt(p11)
    curve = a + b - 2.0 * size
    shift = 0.5 * (b - a) / curve if curve < -1e-9 else 0.0
    shift *= np.sqrt(1.0 + t * t)
    ux, uy = gx / size, gy / size
    out[k, 0], out[k, 1] = column + shift * ux, row + shift * uy
    out[k, 2], out[k, 3], out[k, 4] = ux, uy, size
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _crests(
    dx: Gradient, dy: Gradient, least: float, number: Ints, power: Floats
) -> tuple[Array, Ints]:
    """All crests (N, 5) and their pixels (N, 2); ``number`` gets 1 + their index."""
    height, width = dx.shape
    room = 8192
    found = np.empty((room, 5))
    place = np.empty((room, 2), dtype=np.int32)
    square = np.float32(least * least)
    total = int(np.int64(0))  # as a literal, numba would compile a copy for it
    for below in range(2, height - 2):
        _powers(dx[below], dy[below], power[below])
        row = below - 1
        if row < 3:
            continue
        if total + width > room:
            room = 2 * room + width
            more, places = np.empty((room, 5)), np.empty((room, 2), dtype=np.int32)
            copy_matrix_into(found[:total], more)
            copy_matrix_into(place[:total], places)
            found, place = more, places
        upper, line, lower = power[row - 1], power[row], power[row + 1]
        for column in range(3, width - 3):
            here = line[column]
            if here < square:
                continue
            # Off a crest's line at least one pair of opposite neighbours is no higher.
            if not (line[column - 1] <= here and line[column + 1] <= here) and not (
                upper[column] <= here and lower[column] <= here
            ):
                continue
            if _crest(dx, dy, power, row, column, here, found, total):
                place[total, 0], place[total, 1] = column, row
                total += 1
                number[row, column] = total
    return found[:total], place[:total]


@njit(cache=True, nogil=True, error_model="numpy")
def link(
    dx: Gradient, dy: Gradient, least: float, number: Ints, power: Floats
) -> tuple[Array, Ints, Bools]:
    """Crests of the gradient as chains.

    Args:
        dx, dy: (H, W) Sobel gradients.
        least: gradient of a crest.
        number: (H, W) int32 of zeros, for use and reuse: left as it was.
        power: (H, W) float32, for use and reuse.

    Returns:
        points: (N, 4) x, y (px, sub-pixel), unit gradient x, y, in the order of the chains;
        starts: (C + 1,) where each chain begins; closed: (C,) whether it ends where it began.
    """
    found, place = _crests(dx, dy, least, number, power)
    follower, leader = _successors(found, place, number)
    for i in range(found.shape[0]):
        number[place[i, 1], place[i, 0]] = 0
    return _chains(found, follower, leader)


@njit(cache=True, nogil=True, error_model="numpy")
def _successors(found: Array, place: Ints, number: Ints) -> tuple[Ints, Ints]:
    """The crest that follows each one along its edge, and the one before; -1 for none."""
    total = found.shape[0]
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
                    value = alike + ahead / np.sqrt(ahead_x * ahead_x + ahead_y * ahead_y)
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
    return follower, leader


@njit(cache=True, nogil=True, error_model="numpy")
def _chains(found: Array, follower: Ints, leader: Ints) -> tuple[Array, Ints, Bools]:
    """Points, starts and whether closed of all chains that are long enough to bend."""
    total = found.shape[0]
    points = np.empty((total, 4))
    starts = np.empty(total + 1, dtype=np.int32)
    closed = np.zeros(total, dtype=np.bool_)
    chains, filled = 0, 0
    used = np.zeros(total, dtype=np.bool_)
    for ring in range(2):  # first open chains, then closed ones
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
            if filled - starts[chains] < 10:
                filled = starts[chains]
                continue
            closed[chains] = ring == 1
            chains += 1
    starts[chains] = filled
    return points[:filled], starts[: chains + 1], closed[:chains]
