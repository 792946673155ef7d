"""The target's silhouette in a grey frame, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.outline.specks import MOST_BLOBS, without_specks
from rendezview.sensors.appearance.outline.tracing import crack_outline
from rendezview.sensors.appearance.sky import sky_level
from rendezview.sensors.observation import Status

Border = npt.NDArray[np.int32]
Box = tuple[int, int, int, int]

MOST_AVERAGED_PX = 15  # px; the sum of 15 × 15 grey levels fits 16 bits. Source: by construction
# Blobs whose border is shorter than a quarter of this share of the longest border are skipped.
# Source: by construction, a bound of time
_LEAST_BORDER = 0.02
_NO_GREY = np.zeros((0, 0), dtype=np.uint8)  # Source: by construction


class Threshold(StrEnum):
    """How the grey level that separates target and sky is found."""

    NOISE = "noise"  # above the noise of the sky, measured along the border
    OTSU = "otsu"  # Otsu's level of the whole frame
    FIXED = "fixed"  # as given


class Cleaning(StrEnum):
    """Morphological cleaning of the thresholded frame, 3 × 3 pixels."""

    NONE = "none"  # specks are dropped later; thin booms survive
    OPEN = "open"  # removes specks, and booms thinner than 3 px
    CLOSE = "close"  # bridges gaps of up to 2 px


@dataclass(frozen=True, kw_only=True)
class SilhouetteOptions:
    """What counts as the target."""

    threshold: Threshold = Threshold.NOISE
    level_grey: float | None = None  # grey levels, for FIXED
    # σ; one false pixel in three frames of a megapixel. Source: the normal distribution
    noise_sigmas: float = 5.0
    # Grey levels; quantisation remains where there is no noise.
    # Source: experiment recognition-accuracy, seed 1
    least_contrast_grey: float = 4.0
    # px, side of the mean that is thresholded: it lifts dim panels out of the noise.
    # Source: experiment recognition-accuracy, seed 1
    averaged_px: int = 3
    # px inside the border where the target's level is looked for.
    # Source: experiment recognition-accuracy, seed 1
    reach_px: int = 2
    cleaning: Cleaning = Cleaning.NONE
    background: Picture | None = None  # a frame without the target, subtracted first
    # px; a blob below about 9 px across is all staircase.
    # Source: experiment recognition-accuracy, seed 1
    least_area_px: int = 60
    # Share of the largest blob's area; a smaller blob is noise.
    # Source: experiment recognition-accuracy, seed 1
    speck_fraction: float = 0.0005
    # Share of the largest blob's size; bridges a boom too thin to be visible.
    # Source: experiment recognition-accuracy, seed 1
    merge_gap: float = 0.15
    # Share of the largest blob's area; a blob this large is another body.
    # Source: experiment recognition-accuracy, seed 1
    rival_fraction: float = 0.3

    def __post_init__(self) -> None:
        if self.threshold is Threshold.FIXED and not (
            self.level_grey is not None and 0.0 <= self.level_grey < 255.0
        ):
            raise ValueError(f"a fixed threshold needs level_grey in [0, 255): {self.level_grey}")
        if self.averaged_px not in range(1, MOST_AVERAGED_PX + 1, 2):
            raise ValueError(
                f"averaged_px must be odd, 1 to {MOST_AVERAGED_PX}: {self.averaged_px}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """Outlines of the target in one frame."""

    outlines_px: tuple[Array, ...]  # (M, 2) each, sub-pixel, counter-clockwise on the screen
    area_px: float  # of the filled outlines: holes count
    box_px: Box  # left, top, right, bottom, inclusive
    sky_grey: float
    level_grey: float

    def moved(self, across: float, down: float) -> Silhouette:
        """The same in a larger picture, in which this one starts at a pixel."""
        outlines = tuple(outline + np.array([across, down]) for outline in self.outlines_px)
        left, top, right, bottom = self.box_px
        box = left + int(across), top + int(down), right + int(across), bottom + int(down)
        return replace(self, outlines_px=outlines, box_px=box)

    def enlarged(self, times: int) -> Silhouette:
        """The same in a picture of which each pixel of this one is a square of so many."""
        outlines = tuple((outline + 0.5) * times - 0.5 for outline in self.outlines_px)
        left, top, right, bottom = self.box_px
        box = left * times, top * times, (right + 1) * times - 1, (bottom + 1) * times - 1
        return replace(self, outlines_px=outlines, area_px=self.area_px * times**2, box_px=box)


@dataclass(frozen=True, slots=True)
class Missing:
    """No silhouette, and the reason."""

    status: Status
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class _Blobs:
    """The blobs of a thresholded frame that are large enough, by number."""

    borders: list[Border]
    area: dict[int, float]
    box: dict[int, Box]

    @classmethod
    def of(cls, borders: list[Border]) -> _Blobs:
        """Measure the ``MOST_BLOBS`` of the longest borders; at least one border is needed."""
        size = [len(b) for b in borders]
        longest = list(range(len(size)))
        if len(size) > MOST_BLOBS:
            longest = sorted(sorted(longest, key=lambda k: -size[k])[:MOST_BLOBS])
        least = _LEAST_BORDER * max(size)
        large = [k for k in longest if 4 * size[k] >= least]
        # Pick's theorem: the pixels inside a lattice polygon and on it.
        area = {k: cv2.contourArea(borders[k]) + 0.5 * size[k] + 1.0 for k in large}
        return cls(borders, area, {k: box_of(borders[k]) for k in large})


def find_silhouette(
    image: Picture,
    options: SilhouetteOptions | None = None,
    expected_px: Sequence[float] | Array | None = None,
) -> Silhouette | Missing:
    """Threshold the frame, choose the blobs that are the target, trace their outlines.

    Args:
        image: (H, W) 8-bit grey frame, target brighter than the sky.
        options: how to threshold and which blobs belong together.
        expected_px: (2,) where the target's centre is expected, if that is known. Of several
            bodies the nearest is then taken, and none is reported as a rival.

    Raises:
        RendezviewError: the background frame has another size or type.
    """
    options = options or SilhouetteOptions()
    if options.background is not None:
        image = _without_background(image, options.background)
    sky, noise = sky_level(image, options.averaged_px)
    level = _level(image, options, sky, noise)
    if level >= 255.0:
        return Missing(Status.FULL, f"the sky itself is at {sky:.0f} of 255 grey levels")
    if options.averaged_px > 1:
        mask = mean_above(image, level, options.averaged_px)
    else:
        mask = np.asarray(cv2.threshold(image, level, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)
    if options.cleaning is not Cleaning.NONE:
        kind = cv2.MORPH_OPEN if options.cleaning is Cleaning.OPEN else cv2.MORPH_CLOSE
        mask = cv2.morphologyEx(mask, kind, np.ones((3, 3), np.uint8)).astype(np.uint8, copy=False)
    borders = outer_borders(without_specks(mask))
    if not borders and sky > 127.0:
        return Missing(
            Status.FULL, f"the frame is bright all over ({sky:.0f} of 255): target too close?"
        )
    if not borders:
        return Missing(Status.EMPTY, f"nothing stands out above grey level {level:.0f}")
    chosen = _choose(_Blobs.of(borders), options, expected_px)
    if isinstance(chosen, Missing):
        return chosen
    borders, area_px = chosen
    return _outlined(borders, area_px, image.shape, image, sky, level, options.reach_px)


def _outlined(
    borders: list[Border], area_px: float, shape: tuple[int, ...], grey: Picture = _NO_GREY,
    sky: float = math.nan, level: float = math.nan, reach_px: int = 0,
) -> Silhouette | Missing:  # fmt: skip
    """The silhouette of some blobs of a picture (H, W), unless they touch its border.

    ``grey`` as of ``crack_outline``: none of a drawn mask.
    """
    box = box_around([box_of(border) for border in borders])
    at_border = _border_problem(box, area_px, shape[1], shape[0])
    if at_border is not None:
        return at_border
    contrast = level - sky if grey.size else 0.0
    each = (crack_outline(b, grey, sky if grey.size else 0.0, contrast, reach_px) for b in borders)
    return Silhouette(tuple(each), area_px, box, sky, level)


def _without_background(image: Picture, background: Picture) -> Picture:
    if background.dtype != np.uint8:
        raise RendezviewError(f"the background frame must be 8-bit (uint8), not {background.dtype}")
    if background.shape != image.shape:
        raise RendezviewError(
            f"the background frame is {background.shape[::-1]} px, the frame {image.shape[::-1]} px"
        )
    return cv2.subtract(image, background).astype(np.uint8, copy=False)


def _level(image: Picture, options: SilhouetteOptions, sky: float, noise: float) -> float:
    """Grey level above which a pixel is the target's."""
    if options.threshold is Threshold.FIXED:
        assert options.level_grey is not None  # SilhouetteOptions has checked it
        return options.level_grey
    if options.threshold is Threshold.OTSU:
        otsu = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[0]
        return max(float(otsu), sky + options.least_contrast_grey)
    return sky + max(options.noise_sigmas * noise, options.least_contrast_grey)


def mean_above(image: Picture, level_grey: float, averaged_px: int) -> Picture:
    """(H, W) mask, 255 where the mean over a square of ``averaged_px`` is above a level.

    At its border the outermost pixels are repeated.
    """
    side, limit = (averaged_px, averaged_px), np.floor([level_grey * averaged_px**2])
    sums = cv2.boxFilter(image, cv2.CV_16U, side, normalize=False, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.compare(sums, limit, cv2.CMP_GT), dtype=np.uint8)


def outer_borders(mask: Picture) -> list[Border]:
    """Outer borders (N, 2) of all blobs, 8-connected: x and y of every border pixel."""
    borders = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return [np.asarray(b, dtype=np.int32)[:, 0] for b in borders]


def outlines_of_mask(mask: Picture, least_px: int = 1) -> list[Array]:
    """Outlines (M, 2) in pixels of all blobs of a drawn, noiseless mask.

    Blobs with a border shorter than ``least_px`` are left out.
    """
    borders = (border for border in outer_borders(mask) if len(border) >= least_px)
    return [crack_outline(border, _NO_GREY, 0.0, 0.0, 0) for border in borders]


def silhouette_of_mask(
    mask: Picture, options: SilhouetteOptions | None = None
) -> Silhouette | Missing:
    """The silhouette that a mask (H, W) shows, 255 on the target.

    Args:
        mask: of a drawing, or of a sketch.
        options: which of its pieces belong together; ``None``: all of them.
    """
    borders = outer_borders(mask if options is None else without_specks(mask))
    area_px = float(np.count_nonzero(mask))
    if options is not None:
        if not borders:
            return Missing(Status.EMPTY, "nothing that looks like a spacecraft stands out")
        chosen = _choose(_Blobs.of(borders), options, None)
        if isinstance(chosen, Missing):
            return chosen
        borders, area_px = chosen
    return _outlined(borders, area_px, mask.shape)


def _choose(
    blobs: _Blobs, options: SilhouetteOptions, expected_px: Sequence[float] | Array | None
) -> tuple[list[Border], float] | Missing:
    """Borders and area of the target: the largest blob (or the nearest), and those close to it."""
    area, box = blobs.area, blobs.box
    main = max(area, key=lambda k: area[k])
    bodies = [k for k in area if area[k] >= options.rival_fraction * area[main]]
    if len(bodies) > 1 and expected_px is not None:
        x, y = map(float, expected_px)
        main = min(bodies, key=lambda k: _distance_to_box(x, y, box[k]))
    if area[main] < options.least_area_px:
        return Missing(
            Status.SMALL,
            f"the largest blob has {area[main]:.0f} pixels, fewer than {options.least_area_px}",
        )
    chosen, joined = [main], box[main]
    reach = options.merge_gap * max(joined[2] - joined[0], joined[3] - joined[1])
    least = max(3.0, options.speck_fraction * area[main])
    waiting = {k for k in box if k != main and area[k] >= least}
    while near := [k for k in sorted(waiting) if gap_between(joined, box[k]) <= reach]:
        chosen += near
        joined = box_around([joined, *(box[k] for k in near)])
        waiting -= set(near)
    rivals = [k for k in bodies if k not in chosen]
    if rivals and expected_px is None:
        return Missing(
            Status.RIVALS,
            f"{1 + len(rivals)} bodies of like size and no prior pose to choose by",
        )
    return [blobs.borders[k] for k in chosen], sum(area[k] for k in chosen)


def _border_problem(box: Box, area_px: float, width: int, height: int) -> Missing | None:
    """Why a silhouette that touches the border of the frame is refused; None if it does not."""
    left, top, right, bottom = box
    touched = {
        "left": left <= 0,
        "top": top <= 0,
        "right": right >= width - 1,
        "bottom": bottom >= height - 1,
    }
    if not any(touched.values()):
        return None
    whole = (right - left + 1) * (bottom - top + 1) > 0.95 * width * height
    if whole and area_px > 0.9 * width * height:
        return Missing(Status.FULL, "the silhouette fills the frame")
    sides = ", ".join(side for side, touches in touched.items() if touches)
    return Missing(Status.BORDER, f"the silhouette touches the border ({sides})")


def box_of(border: Border) -> Box:
    """Left, top, right, bottom, inclusive."""
    left, top, width, height = cv2.boundingRect(border)
    return left, top, left + width - 1, top + height - 1


def box_around(boxes: list[Box]) -> Box:
    """The box around some boxes."""
    left, top, right, bottom = zip(*boxes, strict=True)
    return min(left), min(top), max(right), max(bottom)


def gap_between(a: Box, b: Box) -> float:
    """Pixels from one box to the next; 0 where they overlap."""
    dx = max(a[0] - b[2], b[0] - a[2], 0)
    dy = max(a[1] - b[3], b[1] - a[3], 0)
    return math.hypot(dx, dy)


def _distance_to_box(x: float, y: float, box: Box) -> float:
    """Pixels from a point to a box; of two boxes around the point the better centred is nearer."""
    dx = max(box[0] - x, x - box[2], 0.0)
    dy = max(box[1] - y, y - box[3], 0.0)
    off = math.hypot(0.5 * (box[0] + box[2]) - x, 0.5 * (box[1] + box[3]) - y)
    return math.hypot(dx, dy) + 1e-3 * off
