"""Where the target is in each frame: boxes of a detector, masks, or one box or place for all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy.typing as npt
from pydantic import BaseModel, Field, FiniteFloat, TypeAdapter

from rendezview.errors import RendezviewError
from rendezview.geometry.boxes import fault_of, overlap
from rendezview.geometry.camera import Camera
from rendezview.io.files import StrPath, checked, read_json
from rendezview.io.sequences.frame import Frame, Sequence
from rendezview.io.sequences.images import list_images, read_grey

# What `Recognizer.recognize` takes as ``roi`` of a frame; None: nothing is told.
Where = Callable[[Frame], npt.ArrayLike | None]

_SAME = 0.5  # intersection over union of two boxes of one thing. Source: as in detection


class _Detection(BaseModel):
    """One line of BOP's detections; its other keys do not matter here."""

    image_id: int
    scene_id: int | None = None
    category_id: int | None = None
    bbox: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
    score: FiniteFloat = 1.0


_DETECTIONS = TypeAdapter(list[_Detection])


def boxes_by_frame(path: StrPath, sequence: Sequence, obj_id: int | None = None) -> Where:
    """The box (4,) x, y, width, height of each frame, of a detector's file in BOP's form.

    Of several detections in a frame the one of highest score counts; ``obj_id`` chooses among
    their ``category_id``.

    Raises:
        RendezviewError: missing, not of that form, or of no frame of the sequence.
    """
    best = _detections(path, sequence, obj_id, 1)

    def of_frame(frame: Frame) -> npt.ArrayLike | None:
        return best[frame.im_id][0].bbox if frame.im_id in best else None

    return of_frame


def each_box(
    path: StrPath, sequence: Sequence, obj_id: int | None, most: int
) -> tuple[Sequence, Where]:
    """A sequence with each frame once for each of its boxes, and the box of each.

    A frame shows ``most`` instances of the target at most, those of highest score. Of boxes that
    overlap by half the best one counts. A frame without any is left out.

    Raises:
        RendezviewError: as of ``boxes_by_frame``.
    """
    boxes = _detections(path, sequence, obj_id, most)
    frames, told = list[Frame](), dict[str, list[float]]()
    for frame in sequence:
        for k, box in enumerate(boxes.get(frame.im_id, ())):
            frames.append(replace(frame, name=f"{frame.name}, box {k + 1}"))
            told[frames[-1].name] = box.bbox
    return replace(sequence, frames=tuple(frames)), lambda frame: told[frame.name]


def _detections(
    path: StrPath, sequence: Sequence, obj_id: int | None, most: int
) -> dict[int, list[_Detection]]:
    """Of each frame the detections of highest score that do not overlap by half, best first."""
    lines = checked(_DETECTIONS, read_json(path, "detections"), f"{path}: detections")
    found: dict[int, list[_Detection]] = {}
    for line in sorted(lines, key=lambda line: -line.score):
        other_scene = line.scene_id not in (None, sequence.scene_id)
        other_object = obj_id is not None and line.category_id not in (None, obj_id)
        if other_scene or other_object:
            continue
        kept = found.setdefault(line.image_id, [])
        if len(kept) < most and all(_apart(line, other) for other in kept):
            kept.append(line)
    for frame in sequence:
        for box in found.get(frame.im_id, ()):
            _check(box, frame.camera, path)
    if not any(frame.im_id in found for frame in sequence):
        raise RendezviewError(
            f"{path}: none of {len(lines)} detections is of a frame of scene "
            f"{sequence.scene_id}" + ("" if obj_id is None else f" and object {obj_id}")
        )
    return found


def _check(detection: _Detection, camera: Camera, path: StrPath) -> None:
    if fault := fault_of(detection.bbox, camera.width, camera.height):
        raise RendezviewError(
            f"{path}: the box {detection.bbox} of image {detection.image_id} {fault}: a box is x, "
            "y, width, height"
        )


def _apart(one: _Detection, other: _Detection) -> bool:
    """Whether two boxes are of two things."""
    boxes = [(x, y, x + across, y + down) for x, y, across, down in (one.bbox, other.bbox)]
    return overlap(*boxes) <= _SAME


def masks_by_frame(path: Path) -> Where:
    """The mask of each frame, not 0 on the target: one picture for all, or a folder of them.

    In a folder the pictures are named as the frames, or as BOP's masks: ``000012_000000.png`` is
    that of frame 12.

    Raises:
        RendezviewError: missing; a folder without pictures.
    """
    if not path.is_dir():
        mask = read_grey(path)
        return lambda frame: mask
    files = list_images(path)
    if not files:
        raise RendezviewError(f"{path}: no pictures in the folder of masks")
    by_stem: dict[str, Path] = {}
    for file in files:
        for stem in (file.stem, file.stem.rpartition("_")[0]):
            by_stem.setdefault(stem, file)

    def of_frame(frame: Frame) -> npt.ArrayLike | None:
        for stem in (Path(frame.name).stem, f"{frame.im_id:06d}", str(frame.im_id)):
            if stem in by_stem:
                return read_grey(by_stem[stem])
        return None

    return of_frame
