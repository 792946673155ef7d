"""A grey frame: the check that it fits the camera, a smaller one, its noise and its blur."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array

Picture = npt.NDArray[np.uint8]

# Grey level from which a pixel is at least so bright. Source: by construction, of 8 bits
WHITE_GREY = 254

# Blur.
_NARROW_PX, _WIDE_PX = 1.0, 2.0  # σ of two slopes that are compared. Source: by construction
_BLUR_ROWS, _BLUR_PIXELS = 40, 200  # rows and pixels that are looked at. Source: a bound of time
_LEAST_BLUR_EDGES = 12  # Source: by construction, of a quartile
# Grey levels from one pixel to the next but one, and σ of the noise; the steepest pixels are taken,
# but no flatter ones. Source: by construction, grain stays below
_LEAST_STEP_GREY, _STEP_SIGMAS = 10, 8.0
# Surfaces that shade off are no edges, and thin bodies seem sharper: the lower quartile is this
# share of the blur. Source: 28 frames of integrity-draw, blurred by 1.5 to 3 px, seed 9
_QUARTILE_OF_BLUR = 0.82


def _slope_kernel(sigma_px: float, reach_px: int) -> Array:
    """(2 R + 1, 2 R + 1) weights of the slope along a row in a picture blurred by a Gaussian."""
    x = np.arange(-reach_px, reach_px + 1)
    across = np.exp(-0.5 * (x / sigma_px) ** 2)
    along = x * across
    return np.outer(across / across.sum(), along / (along @ x))


_NARROW, _WIDE = _slope_kernel(_NARROW_PX, 3), _slope_kernel(_WIDE_PX, 6)
_BLUR_BORDER_PX = 7  # px; reach of the wide one and a step. Source: by construction


def check_frame(image: npt.ArrayLike, camera: Camera) -> Picture:
    """The frame as 8-bit grey levels (height, width), if it is one of the camera's.

    Colour, in OpenCV's order blue, green, red, becomes grey as that of files, without its
    transparency. 16-bit levels keep the highest eight of the camera's ``bit_depth``.

    Raises:
        RendezviewError: another type, shape or size; 16 bits without a ``bit_depth``, or a level
            that needs more; a floating frame that is not finite.
    """
    if image is None:
        raise RendezviewError("a frame must be an array (height, width), not None: was it read?")
    frame = np.asarray(image)
    if frame.ndim == 3 and frame.shape[2] == 1:
        frame = frame[:, :, 0]
    wide = frame.dtype == np.uint16
    if frame.ndim == 3 and frame.shape[2] in (3, 4) and (wide or frame.dtype == np.uint8):
        frame = cv2.cvtColor(np.ascontiguousarray(frame[:, :, :3]), cv2.COLOR_BGR2GRAY)
    if frame.ndim != 2:
        raise RendezviewError(f"a frame must be (height, width) grey levels, not {frame.shape}")
    if frame.shape != (camera.height, camera.width):
        raise RendezviewError(
            f"the frame is {frame.shape[1]} × {frame.shape[0]} px but the camera is "
            f"{camera.width} × {camera.height} px: give the camera that took it"
        )
    if wide and camera.bit_depth is not None:
        frame = eight_bits(frame, camera.bit_depth)
    if frame.dtype != np.uint8:
        if np.issubdtype(frame.dtype, np.floating) and not np.isfinite(frame).all():
            raise RendezviewError("the frame holds NaN or infinite grey levels")
        remedy = ": give the camera a bit_depth (10, 12, 14 or 16)" if wide else ""
        raise RendezviewError(f"a frame must be 8-bit (uint8), not {frame.dtype}{remedy}")
    return np.ascontiguousarray(frame)


def eight_bits(levels: npt.NDArray[Any], bits: int) -> Picture:
    """Grey levels in eight bits, the highest of ``bits``.

    Raises:
        RendezviewError: a level needs more bits.
    """
    if levels.dtype == np.uint8:
        return np.asarray(levels, dtype=np.uint8)
    peak = int(levels.max(initial=0))
    if peak >= 1 << bits:
        raise RendezviewError(
            f"a level of {peak} needs more than {bits} bits: put the camera's bit_depth into the "
            "camera file"
        )
    return (levels >> (bits - 8)).astype(np.uint8)


def shrunk(image: Picture, times: int) -> Picture:
    """(H // times, W // times) means of squares; an incomplete one at the border is left out."""
    if times == 1:
        return image
    height, width = image.shape[0] // times, image.shape[1] // times
    whole = image[: height * times, : width * times]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


@njit(cache=True, nogil=True)
def grain(image: Picture, rows: int) -> float:
    """Noise of a frame (one σ, grey levels), from second differences along about ``rows`` rows.

    It uses the mean of the smaller half, so that edges and clouds do not count.
    """
    height, width = image.shape
    step = max(1, height // rows)
    counts = np.zeros(512, dtype=np.int64)
    total = 0
    for row in range(step // 2, height, step):
        for column in range(1, width - 1, 7):
            a = int(image[row, column - 1]) - 2 * int(image[row, column])
            counts[min(511, abs(a + int(image[row, column + 1])))] += 1
            total += 1
    if total == 0:
        return 1.0
    valid, mean = 0, 0.0
    for value in range(512):
        take = min(counts[value], total // 2 - valid)
        valid += take
        mean += take * value
        if valid >= total // 2:
            break
    # The mean of the smaller half of |N(0, 1)| is 0.3247; second differences have σ √6.
    return float(mean / max(valid, 1) / (0.3247 * np.sqrt(6.0)))


def frame_blur(image: Picture) -> float:
    """Blur of the sharper edges of a frame, one σ, pixels; 0 where it shows too few of them.

    The slope of an edge of blur b, blurred by s more, falls with √(b² + s²): the ratio of the
    slopes at two s tells b (Zhuo and Sim, Pattern Recognition 44, 2011).
    """
    blurs = np.empty(_BLUR_PIXELS)
    least = max(float(_LEAST_STEP_GREY), _STEP_SIGMAS * grain(image, _BLUR_ROWS))
    found = _edge_blurs(image, least, _NARROW, _WIDE, blurs)
    if found < _LEAST_BLUR_EDGES:
        return 0.0
    return float(np.quantile(blurs[:found], 0.25)) / _QUARTILE_OF_BLUR


@njit(cache=True, nogil=True)
def _edge_blurs(image: Picture, least: float, narrow: Array, wide: Array, blurs: Array) -> int:
    """Blur at the steepest pixels of some rows that are ridges of the slope; how many.

    ``least``: step from one pixel to the next but one; ``narrow``, ``wide``: of `_slope_kernel`.
    """
    height, width = image.shape
    every = max(1, height // _BLUR_ROWS)
    counts = np.zeros(256, dtype=np.int64)
    for row in range(_BLUR_BORDER_PX, height - _BLUR_BORDER_PX, every):
        for column in range(_BLUR_BORDER_PX, width - _BLUR_BORDER_PX):
            counts[_step(image, row, column)] += 1
    limit, steeper = 255, counts[255]
    while limit > least and steeper + counts[limit - 1] <= _BLUR_PIXELS:
        limit -= 1
        steeper += counts[limit]
    found = 0
    for row in range(_BLUR_BORDER_PX, height - _BLUR_BORDER_PX, every):
        for column in range(_BLUR_BORDER_PX, width - _BLUR_BORDER_PX):
            step = _step(image, row, column)
            if step < limit or found == len(blurs):
                continue
            upright = step == abs(_along(image, row, column))
            x, y = (1, 0) if upright else (0, 1)
            # Where white cuts an edge off, it seems sharper.
            white = max(image[row + 3 * y, column + 3 * x], image[row - 3 * y, column - 3 * x])
            before, after = _step(image, row - y, column - x), _step(image, row + y, column + x)
            if step < before or step <= after or white >= WHITE_GREY:
                continue
            gx, gy = _slope(image, row, column, narrow)
            square = gx * gx + gy * gy
            wx, wy = _slope(image, row, column, wide)
            ratio = square / (wx * wx + wy * wy + 1e-9)
            if ratio > 1.0 + 1e-3:
                left = _WIDE_PX * _WIDE_PX - ratio * _NARROW_PX * _NARROW_PX
                blurs[found] = np.sqrt(max(0.0, left / (ratio - 1.0)))
                found += 1
    return found


@njit(cache=True, nogil=True)
def _step(image: Picture, row: int, column: int) -> int:
    """Larger difference of the pixels on both sides, along the row and the column."""
    down = np.int64(image[row + 1, column]) - np.int64(image[row - 1, column])
    return max(abs(_along(image, row, column)), abs(int(down)))


@njit(cache=True, nogil=True)
def _along(image: Picture, row: int, column: int) -> int:
    """Difference of the pixels on both sides, along the row."""
    return int(np.int64(image[row, column + 1]) - np.int64(image[row, column - 1]))


@njit(cache=True, nogil=True)
def _slope(image: Picture, row: int, column: int, kernel: Array) -> tuple[float, float]:
    """Slope at a pixel along the row and the column, by the weights of `_slope_kernel`."""
    reach = kernel.shape[0] // 2
    along, down = 0.0, 0.0
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            level = np.float64(image[row + i, column + j])
            along += kernel[reach + i, reach + j] * level
            down += kernel[reach + j, reach + i] * level
    return along, down
