"""A picture of a file that may hold several, and levels of any type as 16 bits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError

# Flags of OpenCV's decoder: a picture rotated by its EXIF tag does not fit its calibration.
# IMREAD_GRAYSCALE alone drops the low eight of 16 bits.
AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of a file."""

    path: Path
    name: str
    place: int  # what the format's reader finds it by
    time_s: float | None = None
    orientation: int = 1  # of EXIF


def unit_of(samples: list[npt.NDArray[Any]]) -> float:
    """16-bit levels a level of a sequence, by some of its pictures.

    Levels are counts, as files have them. Floating levels of at most 1 are shares of white; counts
    beyond 16 bits lose their lowest ones.
    """
    peaks = [float(np.nanmax(picture, initial=0.0)) for picture in samples if picture.size]
    peak = max((value for value in peaks if np.isfinite(value)), default=0.0)
    if all(np.issubdtype(picture.dtype, np.floating) for picture in samples) and peak <= 1.0:
        return 65_535.0
    unit = 1.0
    while peak * unit >= 65_536.0:
        unit *= 0.5
    return unit


def counts(levels: npt.NDArray[Any], unit: float) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """Levels of any type in 16 bits; none is below 0, and what is not a number is 0.

    Raises:
        RendezviewError: a level is above those by which the unit was found.
    """
    if levels.dtype == np.uint8 or (levels.dtype == np.uint16 and unit == 1.0):
        return np.asarray(levels)
    scaled = np.nan_to_num(levels * unit, nan=0.0, posinf=np.inf, neginf=0.0)
    peak = float(scaled.max(initial=0.0))
    if peak >= 65_536.0:
        raise RendezviewError(
            f"a level of {peak / unit:g} is more than 16 bits hold at the scale of the sequence: "
            "store all pictures in 16 bits"
        )
    return np.maximum(scaled, 0.0).astype(np.uint16)
