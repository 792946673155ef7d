"""A frame of a sequence, and the sequence."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import overload

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.sequences.misfit import misfit

GreyImage = npt.NDArray[np.uint8]  # (height, width)


def grey_of(image: cv2.typing.MatLike) -> GreyImage:
    """A decoded picture, grey or blue, green, red, as grey uint8 (height, width)."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(grey, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture, with its data in the sequence."""

    im_id: int
    name: str  # of the file, or the frame's number in a video
    time_s: float | None
    camera: Camera
    camera_from_target: Pose | None  # truth, if the sequence has it
    obj_id: int  # 1 where unknown
    fetch: Callable[[], GreyImage] = field(repr=False, compare=False)  # see `read`

    def read(self) -> GreyImage:
        """The grey picture, uint8 (height, width) of the camera.

        Raises:
            RendezviewError: missing, not an image, or not of the camera's size.
        """
        image = self.fetch()
        height, width = image.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise RendezviewError(f"{self.name}: {misfit(width, height, self.camera)}")
        return image


@dataclass(frozen=True, slots=True)
class Sequence:
    """Frames in order; ``scene_id`` is their scene number in results files."""

    scene_id: int
    frames: tuple[Frame, ...]
    source: Path
    notes: tuple[str, ...] = ()  # what a user should check, one line each

    @classmethod
    def of_pictures(
        cls,
        source: Path,
        camera: Camera,
        pictures: Iterable[tuple[str, float | None, Callable[[], GreyImage]]],
        notes: Iterable[str] = (),
    ) -> Sequence:
        """Pictures of one camera, numbered from 0, without truth: name, time and reader of each."""
        frames = tuple(
            Frame(k, name, time_s, camera, None, 1, fetch)
            for k, (name, time_s, fetch) in enumerate(pictures)
        )
        return cls(1, frames, source, tuple(notes))

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence: ...
    def __getitem__(self, index: int | slice) -> Frame | Sequence:
        """A frame by its place, or a part as a sequence."""
        if isinstance(index, slice):
            return replace(self, frames=self.frames[index])
        return self.frames[index]

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)
