"""The sensor's input: two pictures in two colours of laser light, or one (Book et al.).

The reflectors' filters pass 830 nm: the *lit* picture shows them, the *dark* one at 780 nm shows
everything else as bright. Their difference is thresholded, and single pixels and thin edges are
eroded away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera

Grey = npt.NDArray[np.uint8]

# rows; the noise is measured on one row in so many, and on not many more than so many in all.
# Source: by construction, a bound of time
_NOISE_STEP, _NOISE_ROWS = 12, 60
_CELL_PX = 8  # px, of the coarse background. Source: by construction, its median takes 0.1 ms
_MEDIAN_CELLS = (25, 9, 5)  # of the medians: 200 px. Source: by construction, over the largest disc
_FILTER_PX = 1.0  # σ. Source: by construction, that of a spot of 2 px FWHM and pixel
_EVERY = 4  # px, of the pixels whose scatter is measured. Source: by construction, 0.2 ms
_DARKEST, _DARKEST_SIGMA = 0.025, 1.96  # share of the darkest, σ. Source: normal distribution
_LEAST_NOISE = 0.5  # grey. Source: by construction, rounding that the filter does not average
_NO_DARK = np.zeros((0, 0), np.uint8)  # Source: by construction
# Of two peaks, the level between them at which they are two. Source: Rayleigh's criterion
_RESOLVED = 0.735


class Opening(StrEnum):
    """The erosion of the thresholded picture, which is then dilated back."""

    NONE = "none"
    SMALL = "small"  # removes regions without 2 × 2 pixels: single pixels, lines of one
    CROSS = "cross"  # what holds no plus of five pixels goes
    SQUARE = "square"  # what holds no 3 × 3 pixels goes: the paper's zeroing of the edge


class Centroid(StrEnum):
    """Which of a spot's three centroids is its place."""

    BINARY = "binary"
    WEIGHTED = "weighted"
    WINDOWED = "windowed"


# Of each opening: kernel, anchors of erosion and dilation. Source: by construction
_KERNELS = {
    Opening.SMALL: (np.ones((2, 2), np.uint8), (1, 1), (0, 0)),  # even: dilated the other way
    Opening.CROSS: (cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), (1, 1), (1, 1)),
    Opening.SQUARE: (np.ones((3, 3), np.uint8), (1, 1), (1, 1)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdOptions:
    """Which pixels may belong to a spot, and its place. Grey levels of the 8-bit pictures."""

    lower_grey: float | None = None  # of the difference; None: from its noise
    # × noise: one pixel in 10¹¹ of pure noise. Source: normal distribution
    noise_factor: float = 7.0
    # × noise: the peak of a spot in a single picture. Source: reflector-real-spots (0.1), where
    # 90 % of the stars above 5 σ are to be found
    faint_factor: float = 5.0
    # Of an automatic threshold: flicker of bright background stays below. Source: by hand;
    # uncritical halved or doubled
    least_grey: float = 12.0
    upper_grey: float | None = None  # of the lit picture: brighter is a glint, not a reflector
    # Of the dark picture: saturated there, the difference is not usable. Source: by construction,
    # just below 255
    dark_grey: float = 250.0
    opening: Opening = Opening.SMALL  # a far reflector may hold no more than 2 × 2 pixels
    centroid: Centroid = Centroid.WINDOWED

    def __post_init__(self) -> None:
        for name in ("lower_grey", "upper_grey"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value <= 255.0:
                raise RendezviewError(f"{name} must be 0 to 255, not {value}")
        for name in ("noise_factor", "least_grey", "dark_grey"):
            if not getattr(self, name) > 0.0:
                raise RendezviewError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class LitDark:
    """The pictures of one reading.

    ``dark`` is None where one picture is all there is. In the beam-splitter mode the second
    camera's pixels are those of the first: see `registered`.

    Raises:
        RendezviewError: no 8-bit grey picture, an empty one, or two of different size.
    """

    lit: Grey  # (H, W)
    dark: Grey | None = None  # (H, W)

    def __post_init__(self) -> None:
        for name in ("lit", "dark"):
            image = getattr(self, name)
            if image is None:
                continue
            array = np.asarray(image)
            if array.ndim != 2 or array.size == 0 or array.dtype != np.uint8:
                raise RendezviewError(
                    f"the {name} picture must be 8-bit grey (H, W), not {array.dtype} {array.shape}"
                )
            object.__setattr__(self, name, np.ascontiguousarray(array))
        if self.dark is not None and self.dark.shape != self.lit.shape:
            raise RendezviewError(
                f"the two pictures differ in size: {self.lit.shape} and {self.dark.shape}"
            )

    @property
    def dark_or_nothing(self) -> Grey:
        """The dark picture, (0, 0) where there is none, for the compiled loops."""
        return _NO_DARK if self.dark is None else self.dark

    def inverted(self) -> LitDark:
        """The pictures of dark dots on a bright ground, as bright dots on a dark one."""
        return LitDark(
            np.asarray(255 - self.lit, dtype=np.uint8),
            None if self.dark is None else np.asarray(255 - self.dark, dtype=np.uint8),
        )

    def check(self, camera: Camera) -> None:
        """Refuse pictures of another size than the camera's.

        Raises:
            RendezviewError: they differ.
        """
        height, width = self.lit.shape
        if (width, height) != (camera.width, camera.height):
            raise RendezviewError(
                f"the picture is {width} × {height} pixels but its camera "
                f"{camera.width} × {camera.height}: use the camera file of these pictures"
            )


def registered(dark: Grey, lit_from_dark: npt.ArrayLike) -> Grey:
    """The dark camera's picture in the pixels of the lit camera (beam-splitter mode).

    ``lit_from_dark`` (2, 3) maps pixels (u, v, 1) of the second camera, behind the same lens,
    to those of the first; it is measured once, on any scene seen by both.

    Raises:
        ValueError: the map is not (2, 3), finite and invertible.
    """
    affine = np.asarray(lit_from_dark, dtype=np.float64)
    if affine.shape != (2, 3) or not np.isfinite(affine).all():
        raise ValueError(f"lit_from_dark must be (2, 3) and finite, not {affine.tolist()}")
    if abs(np.linalg.det(affine[:, :2])) < 1e-3:
        raise ValueError(f"lit_from_dark cannot be inverted: {affine.tolist()}")
    if np.array_equal(affine, np.eye(2, 3)):
        return dark
    height, width = dark.shape
    # A narrower kernel would smooth the noise, whose error neighbouring pixels would then hide.
    return np.asarray(
        cv2.warpAffine(
            dark, affine, (width, height), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
        ),
        dtype=np.uint8,
    )


def noise_grey(frames: LitDark) -> float:
    """Standard deviation of one pixel of the difference, from neighbours, grey levels.

    Half the pixels' differences from their right neighbours lie within 0.6745 · √2 of it;
    spots and edges are few and do not count.
    """
    counts = np.zeros(512, np.int64)
    _count_steps(frames.lit, frames.dark_or_nothing, counts)
    total = int(counts.sum())
    if not total:
        return 1.0
    half = 0.5 * total
    below = np.cumsum(counts)
    level = int(np.searchsorted(below, half))
    before = below[level - 1] if level else 0
    # Whole grey levels: the median is interpolated within its bin, [level − ½, level + ½].
    low, width = (0.0, 0.5) if level == 0 else (level - 0.5, 1.0)
    median = low + width * (half - before) / max(int(counts[level]), 1)
    return max(float(median) / (0.6745 * math.sqrt(2.0)), 0.3)  # 0.3: rounding only


@njit(cache=True, nogil=True, error_model="numpy")
def _count_steps(lit: Grey, dark: Grey, counts: npt.NDArray[np.int64]) -> None:
    """How often neighbours in a row differ by so many grey levels; the difference's where dark."""
    for v in range(0, lit.shape[0], max(_NOISE_STEP, lit.shape[0] // _NOISE_ROWS)):
        if dark.shape[0] > 0:
            last = np.int64(lit[v, 0]) - np.int64(dark[v, 0])
            for u in range(1, lit.shape[1]):
                value = np.int64(lit[v, u]) - np.int64(dark[v, u])
                counts[abs(value - last)] += 1
                last = value
        else:
            for u in range(1, lit.shape[1]):
                counts[abs(np.int64(lit[v, u]) - np.int64(lit[v, u - 1]))] += 1


def threshold_of(options: ThresholdOptions, noise: float, frames: LitDark) -> float:
    """The lower threshold in use, grey levels of the difference.

    In a single picture the automatic one is added to the median of the background.
    """
    if options.lower_grey is not None:
        return options.lower_grey
    behind = 0.0 if frames.dark is not None else float(np.median(frames.lit[::_NOISE_STEP]))
    return min(behind + max(options.noise_factor * noise, options.least_grey), 254.0)


def background_of(lit: Grey) -> Grey:
    """(H, W) smooth background of a single picture: the least of medians over 40, 72 and 200 px.

    A lit room is brighter on one side, and a card may lie on what is as bright as its dots; a disc
    of up to 140 px is no background.
    """
    height, width = lit.shape
    small = (max(width // _CELL_PX, 1), max(height // _CELL_PX, 1))
    cells = cv2.resize(lit, small, interpolation=cv2.INTER_AREA)
    least = cells
    for k, cells_wide in enumerate(_MEDIAN_CELLS):
        size = min(cells_wide, 2 * ((min(small) - 1) // 2) + 1)
        middle = cv2.medianBlur(cells, size) if size >= 3 else cells
        least = middle if k == 0 else cv2.min(least, middle)
    smooth = cv2.resize(least, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth, dtype=np.uint8)


def faint_mask(frames: LitDark, behind: Grey, noise: float, options: ThresholdOptions) -> Grey:
    """(H, W) 255 where a single picture is brighter than its background, after a matched filter.

    A Gaussian of 1 px takes 72 % of white noise away, and half of a star: a spot whose peak is at
    ``faint_factor`` times the noise stands out by 1.5 times that of the filtered noise.
    """
    difference = cv2.subtract(frames.lit, behind, dtype=cv2.CV_32F)
    soft = cv2.GaussianBlur(difference, (0, 0), _FILTER_PX)
    passed = 1.0 / (2.0 * math.sqrt(math.pi) * _FILTER_PX)
    level = options.faint_factor * max(noise * passed, _LEAST_NOISE * passed, _dips(soft))
    mask = np.asarray(cv2.threshold(soft, level, 255.0, cv2.THRESH_BINARY)[1], dtype=np.uint8)
    drop_glare(mask, frames, options)
    return mask


def _dips(soft: npt.NDArray[Any]) -> float:
    """Standard deviation of a filtered picture from its darker side, where no spot is.

    Neighbouring pixels of a compressed picture hardly differ, but its blocks do.
    """
    some = soft[::_EVERY, ::_EVERY].ravel()
    rank = int(_DARKEST * (len(some) - 1))
    middle = len(some) // 2
    parted = np.partition(some, (rank, middle))
    return float(parted[middle] - parted[rank]) / _DARKEST_SIGMA


def drop_glare(mask: npt.NDArray[Any], frames: LitDark, options: ThresholdOptions) -> None:
    """Zero a mask (H, W) where the lit picture is too bright for a reflector, or the dark one."""
    if options.upper_grey is not None:
        mask[frames.lit > options.upper_grey] = 0
    if frames.dark is not None and options.dark_grey < 255.0:
        clear = cv2.threshold(frames.dark, options.dark_grey, 255, cv2.THRESH_BINARY_INV)[1]
        cv2.bitwise_and(mask, clear, dst=mask)


def spot_mask(frames: LitDark, level: float, options: ThresholdOptions) -> Grey:
    """(H, W) 255 where a pixel may belong to a spot."""
    difference = frames.lit if frames.dark is None else cv2.subtract(frames.lit, frames.dark)
    mask = cv2.threshold(difference, level, 255, cv2.THRESH_BINARY)[1]
    drop_glare(mask, frames, options)
    left, top, width, height = cv2.boundingRect(mask)
    if options.opening is not Opening.NONE and width and height:
        # Only where there is anything; the rim about it is dark, as all the rest.
        rows, columns = (
            slice(max(top - 2, 0), top + height + 2),
            slice(max(left - 2, 0), left + width + 2),
        )
        kernel, erode_at, dilate_at = _KERNELS[options.opening]
        part = cv2.erode(mask[rows, columns], kernel, anchor=erode_at)
        mask[rows, columns] = cv2.dilate(part, kernel, anchor=dilate_at)
    return np.asarray(mask, dtype=np.uint8)


def _sides() -> npt.NDArray[np.int64]:
    """(N, 4) two pixels (x, y, x, y) within 2 px of one, on a line past its middle."""
    one = np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), axis=-1).reshape(-1, 2)
    first, second = np.triu_indices(len(one), 1)
    a, b = one[first], one[second]
    passes = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) < 0.5 * np.hypot(*(a - b).T)
    return np.asarray(np.column_stack([a, b])[passes & ((a * b).sum(axis=1) < 0)])


_SIDES = _sides()  # Source: by construction


def cut_valleys(mask: Grey, frames: LitDark, level: float) -> int:
    """Zero the pixels of a mask (H, W) between lights of the difference; how many there are."""
    flat = mask.reshape(-1)
    words = flat[: flat.size - flat.size % 8].view(np.uint64)
    return int(_cut_valleys(flat, words, frames.lit, frames.dark_or_nothing, level))


@njit(cache=True, nogil=True, error_model="numpy")
def _cut_valleys(
    flat: Grey, words: npt.NDArray[np.uint64], lit: Grey, dark: Grey, level: float
) -> int:
    """A pixel of a valley has brighter ones within two pixels on opposite sides.

    By the threshold, and by what Rayleigh asks of two points of light.
    """
    height, width = lit.shape
    cut = 0
    for w in range(words.shape[0] + 1):
        if w < words.shape[0] and words[w] == 0:
            continue
        for at in range(8 * w, min(8 * w + 8, flat.shape[0])):
            if flat[at] == 0:
                continue
            y, x = at // width, at % width
            here = float(lit[y, x]) - float(dark[y, x])
            for k in range(_SIDES.shape[0]):
                sides = np.inf
                for i in range(0, 4, 2):
                    u, v = x + _SIDES[k, i], y + _SIDES[k, i + 1]
                    if 0 <= v < height and 0 <= u < width:
                        sides = min(sides, float(lit[v, u]) - float(dark[v, u]))
                    else:
                        sides = 0.0
                    if here >= min(_RESOLVED * sides, sides - level):
                        break
                else:
                    flat[at] = 0
                    cut += 1
                    break
    return cut
