"""The target's silhouette in a grey frame, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.outline.tracing import crack_outline
from rendezview.sensors.appearance.sky import MOST_AVERAGED_PX, mean_above, sky_level
from rendezview.sensors.observation import Status

Border = npt.NDArray[np.int32]
Box = tuple[int, int, int, int]


class Threshold(StrEnum):
    """How the grey level that parts target from sky is found."""

    NOISE = "noise"  # above the noise of the sky, measured along the border
    OTSU = "otsu"  # Otsu's level of the whole frame
    FIXED = "fixed"  # as told


class Cleaning(StrEnum):
    """Morphological cleaning of the thresholded frame, 3 × 3 pixels."""

    NONE = "none"  # small blobs are dropped anyway; thin booms survive
    OPEN = "open"  # takes away specks and booms thinner than 3 px
    CLOSE = "close"  # bridges gaps of up to 2 px


@dataclass(frozen=True, kw_only=True)
class SilhouetteOptions:
    """What counts as the target."""

    threshold: Threshold = Threshold.NOISE
    level_grey: float | None = None  # for FIXED
    noise_sigmas: float = 5.0  # one false pixel in three frames of a megapixel
    least_contrast_grey: float = 4.0  # a noiseless frame still has quantisation
    averaged_px: int = 3  # a side, of the mean that is thresholded: dim panels leave the noise
    reach_px: int = 2  # how far inside its border the target's own grey level is looked for
    cleaning: Cleaning = Cleaning.NONE
    background: Picture | None = None  # a frame without the target, subtracted first
    least_area_px: int = 60  # below about 9 px across the outline is all staircase
    speck_fraction: float = 0.0005  # of the largest blob: below it, noise
    merge_gap: float = 0.15  # of the largest blob's size: a boom too thin to be seen
    rival_fraction: float = 0.3  # of the largest blob's area: another body

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
    area_px: float  # of the outlines filled, gaps inside counted in
    box_px: Box  # left, top, right, bottom, inclusive
    sky_grey: float
    level_grey: float


@dataclass(frozen=True, slots=True)
class Missing:
    """No silhouette, and why."""

    status: Status
    reason: str


def find_silhouette(
    image: Picture,
    options: SilhouetteOptions | None = None,
    expected_px: npt.ArrayLike | None = None,
) -> Silhouette | Missing:
    """Threshold, outline, choose.

    Args:
        image: (H, W) 8-bit grey frame, target brighter than the sky.
        options: how to threshold and which blobs belong together.
        expected_px: (2,) where the target's centre should be, if that is known: of
            several bodies the nearest is taken, and none is called a rival.
    """
    options = options or SilhouetteOptions()
    if options.background is not None:
        if options.background.dtype != np.uint8:
            raise RendezviewError(
                f"the background frame must be 8-bit (uint8), not {options.background.dtype}"
            )
        if options.background.shape != image.shape:
            raise RendezviewError(
                f"the background frame is {options.background.shape[::-1]} px, "
                f"the frame {image.shape[::-1]} px"
            )
        image = cv2.subtract(image, options.background).astype(np.uint8, copy=False)
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
    return _choose(image, outer_borders(mask), options, sky, level, expected_px)


def outer_borders(mask: Picture) -> list[Border]:
    """Outer borders (N, 2) of all that is on, 8-connected, x and y of every border pixel."""
    borders = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return [np.asarray(b, dtype=np.int32)[:, 0] for b in borders]


def outlines_of_mask(mask: Picture) -> list[Array]:
    """Outlines (M, 2) in pixels of everything that is on in a drawn, noiseless mask."""
    return [crack_outline(border, _NO_GREY, 0.0, 0.0, 0) for border in outer_borders(mask)]


_NO_GREY = np.zeros((0, 0), dtype=np.uint8)


def _level(image: Picture, options: SilhouetteOptions, sky: float, noise: float) -> float:
    if options.threshold is Threshold.FIXED:
        assert options.level_grey is not None  # SilhouetteOptions has checked it
        return options.level_grey
    if options.threshold is Threshold.OTSU:
        otsu = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[0]
        return max(float(otsu), sky + options.least_contrast_grey)
    return sky + max(options.noise_sigmas * noise, options.least_contrast_grey)


def _choose(
    image: Picture,
    borders: list[Border],
    options: SilhouetteOptions,
    sky: float,
    level: float,
    expected_px: npt.ArrayLike | None,
) -> Silhouette | Missing:
    """Which blobs are the target: the largest (or the nearest), and what lies close to it."""
    height, width = image.shape
    if not borders:
        if sky > 127.0:
            return Missing(
                Status.FULL, f"the frame is bright all over ({sky:.0f} of 255): target too close?"
            )
        return Missing(Status.EMPTY, f"nothing stands out above grey level {level:.0f}")
    # Pick's theorem: pixels inside a lattice polygon and on it.
    size = [len(b) for b in borders]
    large = [k for k in range(len(borders)) if 4 * size[k] >= _LEAST_BORDER * max(size)]
    area = {k: cv2.contourArea(borders[k]) + 0.5 * size[k] + 1.0 for k in large}
    main = max(area, key=lambda k: area[k])
    box = {k: box_of(borders[k]) for k in large}
    bodies = [k for k in large if area[k] >= options.rival_fraction * area[main]]
    if len(bodies) > 1 and expected_px is not None:
        ex, ey = np.asarray(expected_px, dtype=np.float64)
        main = min(bodies, key=lambda k: _distance_to_box(ex, ey, box[k]))
    chosen, joined = _merge(main, box, area, options)
    if area[main] < options.least_area_px:
        return Missing(
            Status.SMALL,
            f"the largest blob has {area[main]:.0f} pixels, fewer than {options.least_area_px}",
        )
    rivals = [k for k in bodies if k not in chosen]
    if rivals and expected_px is None:
        return Missing(
            Status.RIVALS,
            f"{1 + len(rivals)} bodies of like size and no prior pose to choose by",
        )
    left, top, right, bottom = joined
    if left <= 0 or top <= 0 or right >= width - 1 or bottom >= height - 1:
        whole = (right - left + 1) * (bottom - top + 1) > 0.95 * width * height
        if whole and sum(area[k] for k in chosen) > 0.9 * width * height:
            return Missing(Status.FULL, "the silhouette fills the frame")
        side = [
            name
            for name, touches in (
                ("left", left <= 0),
                ("top", top <= 0),
                ("right", right >= width - 1),
                ("bottom", bottom >= height - 1),
            )
            if touches
        ]
        return Missing(Status.BORDER, f"the silhouette touches the border ({', '.join(side)})")
    return Silhouette(
        tuple(crack_outline(borders[k], image, sky, level - sky, options.reach_px) for k in chosen),
        sum(area[k] for k in chosen),
        joined,
        sky,
        level,
    )


# A blob whose border is shorter than a quarter of this share of the longest is not looked at.
_LEAST_BORDER = 0.02


def _merge(
    main: int,
    box: dict[int, Box],
    area: dict[int, float],
    options: SilhouetteOptions,
) -> tuple[list[int], Box]:
    """The blobs within reach of the main one, again from the joined box until none is left."""
    chosen, joined = [main], box[main]
    reach = options.merge_gap * max(joined[2] - joined[0], joined[3] - joined[1])
    least = max(3.0, options.speck_fraction * area[main])
    waiting = {k for k in box if k != main and area[k] >= least}
    while True:
        near = [k for k in sorted(waiting) if gap_between(joined, box[k]) <= reach]
        if not near:
            return chosen, joined
        for k in near:
            chosen.append(k)
            b = box[k]
            joined = (
                min(joined[0], b[0]),
                min(joined[1], b[1]),
                max(joined[2], b[2]),
                max(joined[3], b[3]),
            )
        waiting -= set(near)


def box_of(border: Border) -> Box:
    """Left, top, right, bottom, inclusive."""
    left, top, width, height = cv2.boundingRect(border)
    return left, top, left + width - 1, top + height - 1


def gap_between(a: Box, b: Box) -> float:
    """Pixels from one box to the next; 0 where they overlap."""
    dx = max(a[0] - b[2], b[0] - a[2], 0)
    dy = max(a[1] - b[3], b[1] - a[3], 0)
    return float(np.hypot(dx, dy))


def _distance_to_box(x: float, y: float, box: tuple[int, int, int, int]) -> float:
    dx = max(box[0] - x, x - box[2], 0.0)
    dy = max(box[1] - y, y - box[3], 0.0)
    # of two boxes around the point, the one centred on it
    off = np.hypot(0.5 * (box[0] + box[2]) - x, 0.5 * (box[1] + box[3]) - y)
    return float(np.hypot(dx, dy) + 1e-3 * off)
