"""Lights in a picture: the spots of a single picture against a dark sky, as `Spots`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.detectors import UNKNOWN, Spots
from rendezview.sensors.beacons.detect.difference import LitDark, Opening, ThresholdOptions
from rendezview.sensors.beacons.detect.spot_columns import (
    AMPLITUDE,
    AREA,
    BOTTOM,
    LEFT,
    SIGMA,
    X,
    Y,
)
from rendezview.sensors.beacons.detect.spots import find_spots as reflector_spots

_LEAST_NOISE = 0.29  # grey, of rounding. Source: by construction


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


def find_spots(
    image: npt.ArrayLike, options: SpotOptions | None = None, *, dark: npt.ArrayLike | None = None
) -> Spots:
    """All lights in a grey picture (H, W) uint8, brightest first, without names.

    Blobs at the border are left out: half a spot has no centre. What a ``dark`` picture of the
    same scene shows without the lights, as a craft in sunlight, is subtracted.

    Raises:
        RendezviewError: not 8-bit grey pictures of one size.
    """
    options = options or SpotOptions()
    grey, without = np.asarray(image), None if dark is None else np.asarray(dark)
    for picture in (grey,) if without is None else (grey, without):
        small = picture.ndim != 2 or min(picture.shape) < 8
        if small or picture.dtype != np.uint8 or picture.shape != grey.shape:
            raise RendezviewError(
                f"a picture must be (height, width) uint8 of at least 8 × 8, not {picture.shape} "
                f"{picture.dtype}; a dark one must be as large as the other"
            )
    frames, some = LitDark(grey, without), grey[::5, ::5].astype(np.float64)
    sky, noise = _sky(some if without is None else some - without[::5, ::5])
    level = options.threshold_grey if options.threshold_grey is not None else max(8 * noise, 12.0)
    if sky + level >= 255.0:
        return Spots.none()  # no sky to see a light against
    found = reflector_spots(frames, ThresholdOptions(lower_grey=sky + level, opening=Opening.NONE))
    if found.overfull:
        return Spots.none()
    table = found.table[np.argsort(-found.table[:, AMPLITUDE], kind="stable")]
    box, size = table[:, LEFT : BOTTOM + 1], frames.lit.shape[::-1]
    whole = (box[:, :2] > 0.0).all(axis=1) & (box[:, 2:] < np.array(size) - 1).all(axis=1)
    small = (box[:, 2:] - box[:, :2]).max(axis=1) < options.largest_px
    large = table[:, AREA] >= options.least_pixels
    table = table[whole & small & large & (table[:, AMPLITUDE] > 0.0)]
    sigma = np.hypot(table[:, SIGMA], options.least_sigma_px)
    return Spots(
        table[:, [X, Y]], np.column_stack([sigma, sigma]), np.full(len(table), UNKNOWN),
        table[:, AMPLITUDE],
    )  # fmt: skip


def _sky(sample: Array) -> tuple[float, float]:
    """Level and r.m.s. noise of the background, quantisation included."""
    values = sample.ravel()
    middle = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - middle))
    # Whole grey levels make the median and its deviation coarse: mean and r.m.s. of the rest
    unlit = values[np.abs(values - middle) <= 4.0 * spread + 2.0]
    return float(unlit.mean()), max(float(unlit.std()), _LEAST_NOISE)
