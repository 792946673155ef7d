"""Optics and detector: from radiance to grey levels."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.zbuffer import Float32s
from rendezview_ground.limits import POSITIVE, check

UInt8s = npt.NDArray[np.uint8]

_TARGET_GREY = 200.0  # grey level of the brightest tenth of the sunlit target
_MOST_BLACK_GREY = 150.0  # leaves room below the target's. Source: by construction
_SUNLIT_SHARE = 0.1  # of the brightest pixels; sunlit pixels are brighter
_SUNLIT_RADIANCE = 0.03  # sunlit pixels are brighter; dark sides in ambient light are not
_MOST_OVEREXPOSURE = 1000.0  # a dark side in ambient light saturates there too
_OCTAVES = 6  # of the aureole: σ 2, 4 … 64 px
_OCTAVE_SIGMA_PX = 2.0  # px, of the first octave; σ of every one in its own halved pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """Optics and detector. Grey levels are those of the 8-bit picture."""

    exposure: float | None = None  # grey levels per unit of radiance; None: automatic
    overexposure: float = 1.0  # times that exposure; sunlit faces saturate above 1
    blur_sigma_px: float = 0.7  # Gaussian optics
    bloom: float = 0.0  # share of the light in the aureole around bright places
    noise_sigma_grey: float = 3.0  # additive Gaussian read noise
    black_level_grey: float = 5.0  # a detector's offset, so that noise is not cut off at 0
    electrons_per_grey: float | None = None  # photon (shot) noise; None: no shot noise

    def __post_init__(self) -> None:
        check(self, POSITIVE, math.inf, "exposure", "electrons_per_grey")
        check(self, 0.0, math.inf, "blur_sigma_px", "noise_sigma_grey")
        check(self, POSITIVE, _MOST_OVEREXPOSURE, "overexposure")
        check(self, 0.0, 0.99, "bloom")
        check(self, 0.0, _MOST_BLACK_GREY, "black_level_grey")


def automatic_exposure(
    pictures: Iterable[tuple[Float32s, Float32s]], black_level_grey: float = 0.0
) -> float | None:
    """Exposure that puts the brightest tenth of the sunlit target near 200 grey.

    Args:
        pictures: (radiance, coverage) of one or several renderings of the target.

    Returns:
        Grey levels per unit of radiance. The median of the brightest tenth (the 95th percentile) of
        the fully covered, sunlit pixels becomes 200. None if no pixel is sunlit.
    """
    covered = [np.asarray(radiance[coverage > 0.99]) for radiance, coverage in pictures]
    values = np.concatenate(covered) if covered else np.empty(0, np.float32)
    values = values[values > _SUNLIT_RADIANCE]
    if not len(values):
        return None
    bright = values[values > _SUNLIT_SHARE * np.percentile(values, 99.0)]
    return (_TARGET_GREY - black_level_grey) / float(np.percentile(bright, 95.0))


def with_aureole(signal: Float32s, share: float) -> Float32s:
    """The picture (H, W) with a share of its light spread widely, by scattering in the optics.

    The aureole of a point falls with the square of the distance (King, PASP 83, 1971), from 2 px to
    64 px: it is a sum of Gaussians, each twice as wide as the one before, all of the same light.
    """
    height, width = signal.shape
    spread = np.zeros_like(signal)
    halved = signal
    for _ in range(_OCTAVES):
        soft = cv2.GaussianBlur(halved, (0, 0), _OCTAVE_SIGMA_PX, borderType=cv2.BORDER_REPLICATE)
        spread += cv2.resize(soft, (width, height), interpolation=cv2.INTER_LINEAR)
        rows, columns = halved.shape
        size = max(1, columns // 2), max(1, rows // 2)
        halved = np.asarray(cv2.resize(halved, size, interpolation=cv2.INTER_AREA))
    return np.asarray((1.0 - share) * signal + share / _OCTAVES * spread, dtype=np.float32)


def expose(
    radiance: Float32s,
    exposure: float,
    options: SensorOptions,
    rng: np.random.Generator,
    light: Float32s | None = None,
) -> UInt8s:
    """The 8-bit picture of a radiance image (H, W): optics, gain, noise, rounding, saturation.

    ``exposure`` replaces that of the options, which may be automatic; ``light`` (H, W) is added
    behind the optics, grey levels.
    """
    signal = np.asarray(radiance, dtype=np.float32)
    if options.blur_sigma_px > 0.0:
        # Repeats the border, because the scene outside the frame is unknown.
        signal = np.asarray(
            cv2.GaussianBlur(
                signal, (0, 0), options.blur_sigma_px, borderType=cv2.BORDER_REPLICATE
            ),
            dtype=np.float32,
        )
    if options.bloom > 0.0:
        signal = with_aureole(signal, options.bloom)
    grey = signal * np.float32(exposure * options.overexposure)
    if light is not None:
        grey = grey + light
    if options.electrons_per_grey is not None:
        electrons = rng.poisson(np.maximum(grey, 0.0) * options.electrons_per_grey)
        grey = (electrons / options.electrons_per_grey).astype(np.float32)
    grey = grey + np.float32(options.black_level_grey)
    if options.noise_sigma_grey > 0.0:
        noise = rng.standard_normal(grey.shape, dtype=np.float32)
        grey += np.float32(options.noise_sigma_grey) * noise
    return np.asarray(np.clip(np.rint(grey), 0.0, 255.0), dtype=np.uint8)
