"""Where in a frame the target is, as a user or a detector says: a box or a mask."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.contour_at import contour_pixels
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.outline.reading import LateReading, OutlineReading
from rendezview.sensors.appearance.search.windows import overlap

# Of the longer side of a box: what is looked at around it. A detector's box that is 20 % too small
# and 20 % aside still leaves the whole target, and some sky. Source: by construction
_AROUND = 0.3
# Intersection over union of the given box and the pose's: a box whose sides are wrong by 20 %, and
# which is 20 % aside, still has 0.4. Source: by construction
_LEAST_OVERLAP = 0.3
# The same of a mask, whose sides are wrong by a tenth at most. Source: by construction
_LEAST_OF_MASK = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A part of the frame that shows the target whole, and nothing else of importance."""

    box_px: Array  # (4,) left, top, right, bottom: borders of pixels
    part: tuple[int, int, int, int]  # left, top, right, bottom in whole pixels: what is looked at
    mask: Picture | None = None  # (H, W) of the part, 255: target

    @classmethod
    def of(cls, roi: npt.ArrayLike, camera: Camera) -> Region:
        """The region of a box (4,) x, y, width, height, px, or of a mask (H, W), not 0: target.

        Raises:
            RendezviewError: neither, or nothing of it lies in the frame.
        """
        given, width, height = np.asarray(roi), camera.width, camera.height
        if given.shape == (height, width):
            inside = given != 0
            rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
            if not len(rows):
                raise RendezviewError("the mask of the target is empty: nothing to look at")
            first, last = (np.array([columns[k], rows[k]]) for k in (0, -1))
            region = cls.around(np.concatenate([first - 0.5, last + 0.5]), camera)
            mask = np.where(inside, 255, 0).astype(np.uint8)
            return replace(region, mask=region.cut(mask))
        if given.shape != (4,) or not np.isfinite(given.astype(np.float64)).all():
            raise RendezviewError(
                "where to look must be a box (x, y, width, height) in pixels, or a mask of the "
                f"frame's size ({height}, {width}), not an array of shape {given.shape}"
            )
        x, y, across, down = (float(number) for number in given)
        if across <= 0.0 or down <= 0.0:
            raise RendezviewError(f"a box must have a width and a height, not {across} × {down} px")
        if x >= width or y >= height or x + across <= 0.0 or y + down <= 0.0:
            raise RendezviewError(
                f"the box at ({x:g}, {y:g}) of {across:g} × {down:g} px lies outside the frame of "
                f"{width} × {height} px"
            )
        box = np.array([x, y, x + across, y + down]) - 0.5
        return cls.around(box, camera)

    @classmethod
    def around(cls, box: Array, camera: Camera) -> Region:
        """Around a box (4,) left, top, right, bottom, px."""
        more = _AROUND * max(box[2] - box[0], box[3] - box[1])
        left, top = np.maximum(np.floor(box[:2] - more + 0.5), 0).astype(int).tolist()
        right, bottom = np.ceil(box[2:] + more + 0.5).astype(int).tolist()
        return cls(box, (left, top, min(right, camera.width), min(bottom, camera.height)))

    def seen_by(self, camera: Camera) -> Camera:
        """The camera of the part."""
        left, top, right, bottom = self.part
        return camera.cropped(left, top, right - left, bottom - top)

    def cut(self, picture: Picture) -> Picture:
        """The part of a picture (H, W)."""
        left, top, right, bottom = self.part
        return np.ascontiguousarray(picture[top:bottom, left:right])

    def in_frame(self, seen: AppearanceObservation) -> AppearanceObservation:
        """What was observed in the part, its outline in the pixels of the frame."""

        def moved(reading: OutlineReading) -> OutlineReading:
            if reading.silhouette is None:
                return reading
            return replace(reading, silhouette=reading.silhouette.moved(*self.part[:2]))

        if isinstance(seen.outline, LateReading):
            late = seen.outline
            return replace(seen, outline=LateReading(lambda: moved(late())))
        return replace(seen, outline=moved(seen.outline))

    def shows(self, model: ViewModel, camera: Camera, pose: Pose) -> bool:
        """Whether the target at a pose, in the part that a camera sees, is where it should be."""
        given = self.box_px - np.tile(self.part[:2], 2)
        least = _LEAST_OVERLAP if self.mask is None else _LEAST_OF_MASK
        return overlap(given, target_box(model, camera, pose)) >= least


def target_box(model: ViewModel, camera: Camera, pose: Pose) -> Array:
    """(4,) left, top, right, bottom, px, of the target at a pose; zeros where it has no picture."""
    seen = contour_pixels(model, camera, pose)
    if seen is None or not len(seen.points_px):
        return np.zeros(4)
    return np.concatenate([seen.points_px.min(0), seen.points_px.max(0)])
