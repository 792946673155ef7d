"""Lights in a picture: bright blobs, each with a sub-pixel place and its σ.

A blob's pixels give a first place, `rendezview.estimation.spot_centroid` the last.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.estimation.spot_centroid import centre_spot, ring_plane, saturated_error
from rendezview.sensors.beacons.detect.detectors import UNKNOWN, Spots

Array = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

_SATURATED = 254  # Source: by construction, the last but one of 8 bits
_LEAST_NOISE = 0.29  # grey, of rounding. Source: by construction
_MOST_BLOBS = 2000  # a frame with more shows no lights. Source: by construction, a bound of time


@dataclass(frozen=True, kw_only=True)
class SpotOptions:
    """What counts as a light."""

    threshold_grey: float | None = None  # above the sky; None: 8 σ of the noise, at least 12 grey
    # above the threshold: a single one may be a hot pixel. Source: by construction
    least_pixels: int = 2
    largest_px: float = 40.0  # diameter; a larger blob is no LED. Source: a chosen limit
    # Of a place, at the best: the pixels themselves differ. Source: by hand
    least_sigma_px: float = 0.002

    def __post_init__(self) -> None:
        if self.threshold_grey is not None and not 0.0 < self.threshold_grey < 255.0:
            raise RendezviewError(f"a threshold must be 0 to 255 grey, not {self.threshold_grey}")


def find_spots(image: npt.ArrayLike, options: SpotOptions | None = None) -> Spots:
    """All lights in a grey picture (H, W) uint8, brightest first, without names.

    Blobs at the border are left out: half a spot has no centre.

    Raises:
        RendezviewError: not an 8-bit grey picture.
    """
    options = options or SpotOptions()
    grey = np.asarray(image)
    if grey.ndim != 2 or grey.dtype != np.uint8 or min(grey.shape) < 8:
        raise RendezviewError(
            f"a picture must be (height, width) uint8 of at least 8 × 8, not {grey.shape} "
            f"{grey.dtype}"
        )
    grey = np.ascontiguousarray(grey)
    sky, noise = _sky(grey[::5, ::5])
    level = options.threshold_grey if options.threshold_grey is not None else max(8 * noise, 12.0)
    if sky + level >= 255.0:
        return Spots.none()  # no sky to see a light against
    _, mask = cv2.threshold(grey, sky + level, 255, cv2.THRESH_BINARY)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if len(outlines) > _MOST_BLOBS:
        return Spots.none()
    found = []
    height, width = grey.shape
    for outline in outlines:
        x, y, w, h = cv2.boundingRect(outline)
        at_border = x == 0 or y == 0 or x + w == width or y + h == height
        if at_border or max(w, h) > options.largest_px:
            continue
        if cv2.countNonZero(mask[y : y + h, x : x + w]) < options.least_pixels:
            continue
        spot = _centre(grey, x, y, w, h, sky, noise)
        if spot[2] > 0.0:
            found.append(spot)
    if not found:
        return Spots.none()
    found.sort(key=lambda spot: -spot[3])
    table = np.array(found)
    sigma = np.hypot(table[:, 2], options.least_sigma_px)
    return Spots(
        table[:, :2], np.column_stack([sigma, sigma]), np.full(len(table), UNKNOWN), table[:, 3]
    )


def _sky(sample: GreyImage) -> tuple[float, float]:
    """Level and r.m.s. noise of the background, quantisation included."""
    values = sample.ravel().astype(np.float64)
    middle = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - middle))
    # Whole grey levels make the median and its deviation coarse: mean and r.m.s. of the rest
    unlit = values[np.abs(values - middle) <= 4.0 * spread + 2.0]
    return float(unlit.mean()), max(float(unlit.std()), _LEAST_NOISE)


@njit(cache=True, nogil=True)
def _centre(
    grey: GreyImage, x0: int, y0: int, w: int, h: int, sky: float, noise: float
) -> tuple[float, float, float, float]:
    """Centre, its σ (0: no spot) and the peak of the blob in a bounding box."""
    total = sx = sy = 0.0
    saturated = 0
    for j in range(y0, y0 + h):
        for i in range(x0, x0 + w):
            value = max(float(grey[j, i]) - sky, 0.0)
            total, sx, sy = total + value, sx + value * i, sy + value * j
            saturated += grey[j, i] >= _SATURATED
    if not total > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    x, y = sx / total, sy / total
    height, width = grey.shape
    columns, rows, nothing = np.empty(width), np.empty(height), grey[:0, :0]
    level, slope_x, slope_y, rough, doubt = ring_plane(
        grey, nothing, (x0, x0 + w - 1, y0, y0 + h - 1), noise
    )
    level += slope_x * (x - x0 - 0.5 * (w - 1)) + slope_y * (y - y0 - 0.5 * (h - 1))
    plane, start = (level, slope_x, slope_y, doubt), (x, y, max(w, h) / 4.0)
    x, y, size, peak, sigma = centre_spot(grey, nothing, plane, start, rough, columns, rows)
    if abs(x - x0 - 0.5 * w) > w + 2 or abs(y - y0 - 0.5 * h) > h + 2 or not peak > 0.0:
        return 0.0, 0.0, 0.0, 0.0  # it left its blob
    return x, y, saturated_error(sigma, saturated, size), peak
