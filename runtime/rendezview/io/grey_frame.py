"""A grey frame: the check that it fits the camera, a smaller one, and its noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera

Picture = npt.NDArray[np.uint8]

# Grey level from which a pixel is at least so bright. Source: by construction, of 8 bits
WHITE_GREY = 254


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
