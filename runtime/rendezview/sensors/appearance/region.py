"""Where in a frame the target is, as a user or a detector says: a box or a mask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.boxes import fault_of, overlap
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture, shrunk
from rendezview.sensors.appearance.edges.contour_at import target_box
from rendezview.sensors.appearance.edges.network import Box
from rendezview.sensors.appearance.judge.near import RANGE_ERROR
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.outline.reading import LateReading, OutlineReading
from rendezview.sensors.appearance.outline.silhouette import Silhouette

# Of the longer side of a box: what is looked at around it. A detector's box that is 20 % too small
# and 20 % aside still leaves the whole target, and some sky. Source: by construction
_AROUND = 0.3
# Intersection over union of the given box and the pose's: a box whose sides are wrong by 20 %, and
# which is 20 % aside, still has 0.4. Source: by construction
_LEAST_OVERLAP = 0.3
# The same of a mask, whose sides are wrong by a tenth at most. Source: by construction
_LEAST_OF_MASK = 0.6
_BESIDE = 0.2  # of the box of a pose: a place may lie so far beside it. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Where in a frame the whole target is, and the part of the frame that is looked at."""

    part: tuple[int, int, int, int]  # left, top, right, bottom in whole pixels
    box_px: Array | None = None  # (4,) left, top, right, bottom: borders of pixels
    mask: Picture | None = None  # (H, W) of the part, 255: target
    place_px: Array | None = None  # (2,) somewhere on the target
    range_m: float | None = None

    @classmethod
    def of(cls, roi: npt.ArrayLike, camera: Camera) -> Region:
        """The region that a user or a detector tells.

        Args:
            roi: a box (4,) x, y, width, height, px; a mask (H, W), not 0: target; a place on the
                target (2,) x, y, px; or that and the target's range (3,) x, y, m.
            camera: of the frames.

        Raises:
            RendezviewError: none of these, or nothing of it lies in the frame.
        """
        given, width, height = np.asarray(roi), camera.width, camera.height
        if given.shape == (height, width):
            return cls._of_mask(given != 0, camera)
        if given.shape not in ((2,), (3,), (4,)) or not np.isfinite(given.astype(float)).all():
            raise RendezviewError(
                "where to look must be a box (x, y, width, height) in pixels, a place (x, y) or "
                f"(x, y, range in metres), or a mask of the frame's size ({height}, {width}), not "
                f"an array of shape {given.shape}"
            )
        numbers = given.astype(np.float64)
        x, y, *sizes = numbers.tolist()
        if any(size <= 0.0 for size in sizes):
            raise RendezviewError(f"a box's size and a range must be positive, not {sizes}")
        if len(sizes) == 2:
            if fault := fault_of(numbers.tolist(), width, height):
                raise RendezviewError(f"the box {numbers.tolist()} {fault}")
            return cls.around(
                np.concatenate([numbers[:2], numbers[:2] + numbers[2:]]) - 0.5, camera
            )
        if not (0.0 <= x <= width and 0.0 <= y <= height):
            raise RendezviewError(
                f"the place at ({x:g}, {y:g}) lies outside the frame of {width} × {height} px"
            )
        range_m = sizes[0] if sizes else None
        return cls((0, 0, width, height), place_px=numbers[:2], range_m=range_m)

    @classmethod
    def _of_mask(cls, inside: npt.NDArray[np.bool_], camera: Camera) -> Region:
        rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
        if not len(rows):
            raise RendezviewError("the mask of the target is empty: nothing to look at")
        first, last = (np.array([columns[k], rows[k]]) for k in (0, -1))
        region = cls.around(np.concatenate([first - 0.5, last + 0.5]), camera)
        return replace(region, mask=region.cut(np.where(inside, 255, 0).astype(np.uint8)))

    @classmethod
    def around(cls, box: Array, camera: Camera) -> Region:
        """Around a box (4,) left, top, right, bottom, px."""
        more = _AROUND * max(box[2] - box[0], box[3] - box[1])
        left, top = np.maximum(np.floor(box[:2] - more + 0.5), 0).astype(int).tolist()
        right, bottom = np.ceil(box[2:] + more + 0.5).astype(int).tolist()
        part = left, top, min(right, camera.width), min(bottom, camera.height)
        return cls(part, box)

    @classmethod
    def at_place(cls, model: ViewModel, camera: Camera, pose: Pose) -> Region | None:
        """Around the target at a pose, whatever its attitude; None where it is not ahead."""
        centre = pose.apply(model.centre_m)
        place = np.asarray(camera.project(centre))
        if centre[2] <= model.target_radius_m or not np.isfinite(place).all():
            return None
        half = max(camera.fx, camera.fy) * model.target_radius_m / centre[2]
        if (place < 0.0).any() or (place > [camera.width - 1.0, camera.height - 1.0]).any():
            return None
        region = cls.around(np.concatenate([place - half, place + half]), camera)
        range_m = float(np.linalg.norm(centre))
        return replace(region, box_px=None, place_px=place, range_m=range_m)

    @property
    def is_open(self) -> bool:
        """Whether the size of the target's picture is not known."""
        return self.box_px is None

    def seen_by(self, camera: Camera) -> Camera:
        """The camera of the part."""
        left, top, right, bottom = self.part
        return camera.cropped(left, top, right - left, bottom - top)

    @property
    def box_in_part(self) -> Box | None:
        """The box in the part's pixels, if there is one."""
        if self.box_px is None:
            return None
        left, top, right, bottom = (self.box_px - np.tile(self.part[:2], 2)).tolist()
        return left, top, right, bottom

    def cut(self, picture: Picture) -> Picture:
        """The part of a picture (H, W)."""
        left, top, right, bottom = self.part
        return np.ascontiguousarray(picture[top:bottom, left:right])

    def in_frame(self, seen: AppearanceObservation) -> AppearanceObservation:
        """What was observed in the part, its outline in the pixels of the frame."""
        return with_outline(seen, lambda body: body.moved(*self.part[:2]))

    def shrunk(self, times: int) -> Region:
        """The same in a frame that is ``times`` smaller."""
        if times == 1:
            return self
        left, top, right, bottom = self.part
        first, size = (left // times, top // times), (right // times, bottom // times)
        box, mask, place = self.box_px, self.mask, self.place_px
        if mask is not None:
            beside = ((top % times, 0), (left % times, 0))
            mask = np.where(shrunk(np.pad(mask, beside), times) > 127, 255, 0).astype(np.uint8)
        if box is not None:
            box = (box + 0.5) / times - 0.5
        if place is not None:
            place = (place + 0.5) / times - 0.5
        return Region((*first, *size), box, mask, place, self.range_m)

    def shows(self, model: ViewModel, camera: Camera, pose: Pose) -> bool:
        """Whether the target at a pose, in the part that a camera sees, is where it should be."""
        box = np.array(target_box(model, camera, pose)) + np.tile(self.part[:2], 2)
        if self.box_px is not None:
            least = _LEAST_OVERLAP if self.mask is None else _LEAST_OF_MASK
            return overlap(self.box_px, box) >= least
        if self.range_m is not None:
            range_m = float(np.linalg.norm(pose.apply(model.centre_m)))
            if abs(range_m - self.range_m) > RANGE_ERROR * self.range_m:
                return False
        return self.holds(box)

    def holds(self, box: Array) -> bool:
        """Whether the place that was told, if any, is on a body with a box (4,), frame px."""
        if self.place_px is None:
            return True
        beside = _BESIDE * max(box[2] - box[0], box[3] - box[1])
        x, y = self.place_px
        inside = box[0] - beside <= x <= box[2] + beside
        return bool(inside and box[1] - beside <= y <= box[3] + beside)


def with_outline(
    seen: AppearanceObservation, moved: Callable[[Silhouette], Silhouette]
) -> AppearanceObservation:
    """The observation with its silhouette, if it has one, in the pixels of another picture."""

    def there(reading: OutlineReading) -> OutlineReading:
        if reading.silhouette is None:
            return reading
        return replace(reading, silhouette=moved(reading.silhouette))

    if isinstance(seen.outline, LateReading):
        late = seen.outline
        return replace(seen, outline=LateReading(lambda: there(late())))
    return replace(seen, outline=there(seen.outline))
