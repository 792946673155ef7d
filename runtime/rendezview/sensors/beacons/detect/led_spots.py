"""Lights in a picture: the spots of a single picture against a dark sky, as `Spots`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.sensors.beacons.detect.detectors import UNKNOWN, Spots
from rendezview.sensors.beacons.detect.difference import LitDark, Opening, ThresholdOptions
from rendezview.sensors.beacons.detect.spots import (
    AMPLITUDE,
    AREA,
    BOTTOM,
    LEFT,
    SIGMA,
    X,
    Y,
)
from rendezview.sensors.beacons.detect.spots import find_spots as reflector_spots

GreyImage = npt.NDArray[np.uint8]

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
    frames = LitDark(grey)
    sky, noise = _sky(frames.lit[::5, ::5])
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


def _sky(sample: GreyImage) -> tuple[float, float]:
    """Level and r.m.s. noise of the background, quantisation included."""
    values = sample.ravel().astype(np.float64)
    middle = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - middle))
    # Whole grey levels make the median and its deviation coarse: mean and r.m.s. of the rest
    unlit = values[np.abs(values - middle) <= 4.0 * spread + 2.0]
    return float(unlit.mean()), max(float(unlit.std()), _LEAST_NOISE)
