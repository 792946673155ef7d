"""The sky behind the target: its grey level, its noise, and whether it is dark."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture, grain

# grey levels; a sky above this level is bright. Source: by hand, seeds of docs/notes/refinement.md
_DARK_SKY_GREY = 60.0
# grey levels; the border may vary by this much beyond the noise. Source: by hand, seeds of
# docs/notes/refinement.md
_SCATTER_GREY = 3.0
# rows; on so many the noise of neighbouring pixels is measured. Source: by construction, a bound of
# time
_GRAIN_ROWS = 64
# px; in a smaller frame (width + height) windows overlap. Source: by construction, a bound of time
_OVERLAPPING_BELOW_PX = 1000
_ONE_SIGMA_BELOW = 0.1587  # quantile of a normal distribution. Source: by construction
_HALF_SIGMA_ABOVE = 0.6915  # quantile of a normal distribution. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """Level and noise of the background, and the direction to the Sun."""

    level_grey: float
    noise_grey: float  # one σ, of neighbouring pixels
    dark: bool  # black sky: everything brighter is the target
    sun_camera: Array | None = None  # (3,) unit, towards the Sun, camera frame, if it is known
    # (6,) for the compiled loops: noise, level, 1 where dark, and the Sun, 0 where unknown
    vector: Array = field(init=False)

    def __post_init__(self) -> None:
        sun = np.zeros(3) if self.sun_camera is None else self.sun_camera
        vector = np.array([self.noise_grey, self.level_grey, float(self.dark), *sun])
        object.__setattr__(self, "vector", vector)

    @classmethod
    def of(cls, image: Picture, sun_camera: npt.ArrayLike | None = None) -> Sky:
        """Measure the sky along the border and on a sparse grid.

        Args:
            image: (H, W) frame.
            sun_camera: (3,) towards the Sun, camera frame, of any length, if it is known.

        Raises:
            ValueError: the direction to the Sun is zero or not finite.
        """
        sun = None
        if sun_camera is not None:
            sun = np.asarray(sun_camera, dtype=np.float64)
            length = float(np.linalg.norm(sun))
            if sun.shape != (3,) or not 0.0 < length < np.inf:
                raise ValueError(
                    f"sun_camera must be three finite numbers, not all zero: {sun_camera!r}"
                )
            sun = sun / length
        level, spread = sky_level(image)
        noise = max(0.7, min(spread, grain(image, _GRAIN_ROWS)))
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        bright = float(np.mean(border > level + 4.0 * noise + _SCATTER_GREY))
        dark = level < _DARK_SKY_GREY and spread < 2.0 * noise + _SCATTER_GREY and bright < 0.02
        return cls(level, noise, dark, sun)


def sky_level(image: Picture, averaged_px: int = 1) -> tuple[float, float]:
    """Median and spread (one σ) of the grey levels along the border of a frame.

    The spread comes from the darker half; where that half is cut off at black, from the
    brighter half. A silhouette that touches the border is refused later, so the border is sky.

    Args:
        image: (H, W) frame.
        averaged_px: side of the square windows whose means are taken instead of pixels.
    """
    level, spread = _border_statistics(image, averaged_px)
    return float(level), float(spread)


@njit(cache=True, nogil=True, error_model="numpy")
def _border_statistics(image: Picture, side: int) -> tuple[float, float]:
    height, width = image.shape
    counts = np.zeros(256, dtype=np.int64)
    if side == 1 or side >= min(height, width):
        for k in range(min(3, height, width)):
            for x in range(width):
                counts[image[k, x]] += 1
                counts[image[height - 1 - k, x]] += 1
            for y in range(height):
                counts[image[y, k]] += 1
                counts[image[y, width - 1 - k]] += 1
    else:
        step = side if width + height > _OVERLAPPING_BELOW_PX else 1
        first = int(np.int64(0))  # as a literal, numba would compile a copy for it
        for x in range(0, width - side + 1, step):
            counts[_window_mean(image, first, x, side)] += 1
            counts[_window_mean(image, height - side, x, side)] += 1
        for y in range(0, height - side + 1, step):
            counts[_window_mean(image, y, first, side)] += 1
            counts[_window_mean(image, y, width - side, side)] += 1
    level = _quantile(counts, 0.5)
    below = _quantile(counts, _ONE_SIGMA_BELOW)
    if below > 0.5:
        return level, level - below
    # The noise of a black sky is cut off at 0: measure it above the median.
    return level, max(level - below, 2.0 * (_quantile(counts, _HALF_SIGMA_ABOVE) - level))


@njit(cache=True, nogil=True, error_model="numpy")
def _window_mean(image: Picture, top: int, left: int, side: int) -> int:
    """Rounded mean of a square window."""
    total = 0
    for y in range(top, top + side):
        for x in range(left, left + side):
            total += image[y, x]
    return (total + side * side // 2) // (side * side)


@njit(cache=True, nogil=True, error_model="numpy")
def _quantile(counts: npt.NDArray[np.int64], share: float) -> float:
    """Grey level below which a share of the counts (256,) lies, interpolated within its level."""
    total, passed, grey = 0, 0, 0
    for count in counts:
        total += count
    wanted = share * total
    while passed + counts[grey] <= wanted:
        passed += counts[grey]
        grey += 1
    return float(grey - 0.5 + (wanted - passed) / counts[grey])
