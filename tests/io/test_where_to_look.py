"""Boxes of detectors and masks: where the target is in each frame."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rendezview import RendezviewError
from rendezview.cli.inputs import numbers_of
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import Frame, Sequence
from rendezview.io.where_to_look import boxes_by_frame, each_box, masks_by_frame

CAMERA = Camera.from_fov(64, 48, 0.5)


def frame(number: int) -> Frame:
    return Frame(number, f"{number:06d}.png", None, CAMERA, None, 1,
                 lambda: np.zeros((48, 64), np.uint8))  # fmt: skip


SEQUENCE = Sequence(3, (frame(0), frame(1), frame(12)), Path("scene"))


def line(image: int, x: float, score: float = 0.5, **others: object) -> dict[str, object]:
    return {"image_id": image, "bbox": [x, 2, 10, 12], "score": score, "time": -1, **others}


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_the_likeliest_box_of_the_scene_and_the_object_counts(tmp_path):
    lines = [line(0, 1, 0.4), line(0, 5, 0.9), line(0, 7, 0.95, scene_id=4),
             line(12, 9, category_id=2), line(12, 11, 0.1, category_id=1, scene_id=3)]  # fmt: skip
    path = written(tmp_path / "boxes.json", lines)
    where = boxes_by_frame(path, SEQUENCE)
    assert [where(f) for f in SEQUENCE] == [[5, 2, 10, 12], None, [9, 2, 10, 12]]
    assert boxes_by_frame(path, SEQUENCE, 1)(frame(12)) == [11, 2, 10, 12]


def test_each_box_of_the_object_is_an_instance_unless_a_better_one_covers_it(tmp_path):
    lines = [line(0, 1, 0.4), line(0, 30, 0.9), line(0, 32, 0.8), line(0, 48, 0.3),
             line(0, 15, 0.99, category_id=7), line(12, 9, category_id=2)]  # fmt: skip
    path = written(tmp_path / "boxes.json", [{"category_id": 2, **one} for one in lines])
    frames, where = each_box(path, SEQUENCE, 2, 2)
    assert [f.im_id for f in frames] == [0, 0, 12]
    assert [where(f)[0] for f in frames] == [30, 1, 9]
    frames, where = each_box(path, SEQUENCE, 2, 9)
    assert [where(f)[0] for f in frames] == [30, 1, 48, 9]


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        ([line(99, 1)], "none of 1 detections is of a frame of scene 3"),
        ([line(1, 64)], "outside"),
        ([{"image_id": 1, "bbox": [1, 2, 0, 5]}], "smaller than a pixel"),
        ([{"image_id": 1, "bbox": [-1e4, 2, 2e4, 5]}], "more than 4 times as large"),
        ([{"image_id": 1, "bbox": [1, 2, 3]}], "bbox"),
        ([{"bbox": [1, 2, 3, 4]}], "image_id"),
        ([line(1, "12.5")], r"0.bbox.0: input should be a valid number"),
        ([line(1, True)], r"0.bbox.0: input should be a valid number"),
        ([line("1", 2)], r"0.image_id: input should be a valid integer"),
        ({"boxes": []}, "valid array"),
    ],
)
def test_a_file_that_tells_no_box_is_refused(tmp_path, lines, fault):
    with pytest.raises(RendezviewError, match=fault):
        boxes_by_frame(written(tmp_path / "boxes.json", lines), SEQUENCE)


def test_masks_are_found_by_the_names_of_frames_and_as_bop_names_them(tmp_path):
    for number, name in enumerate(("000000.png", "000012_000001.png", "notes.txt")):
        if name.endswith("png"):
            cv2.imwrite(str(tmp_path / name), np.full((48, 64), 10 + number, np.uint8))
        else:
            (tmp_path / name).write_text("none")
    where = masks_by_frame(tmp_path)
    assert where(frame(0)).max() == 10
    assert where(frame(1)) is None
    assert where(frame(12)).max() == 11
    for_all = masks_by_frame(tmp_path / "000000.png")
    assert for_all(frame(1)).max() == 10


def test_a_folder_without_masks_is_refused(tmp_path):
    with pytest.raises(RendezviewError, match="no pictures"):
        masks_by_frame(tmp_path)


def test_numbers_of_an_option():
    assert numbers_of("1,2.5", "--at", (2, 3)) == pytest.approx([1.0, 2.5])
    for text in ("1", "1,2,3,4", "1,x", "1,nan", ""):
        with pytest.raises(RendezviewError, match="--at needs 2 or 3 numbers"):
            numbers_of(text, "--at", (2, 3))
