"""Shards of BOP data sets."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import open_sequence

PIXELS = np.random.default_rng(73).integers(0, 256, (4, 48, 64), dtype=np.uint8)
K = [80.0, 0.0, 31.0, 0.0, 81.0, 24.0, 0.0, 0.0, 1.0]
PLAIN = Camera(64, 48, 80.0, 81.0, 31.0, 24.0)


def truth(obj_id: int = 5, z: float = 4000.0) -> dict[str, Any]:
    turn = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    return {"obj_id": obj_id, "cam_R_m2c": turn, "cam_t_m2c": [0.0, 0.0, z]}


def write_shard(
    path: Path, keys: list[str], truths: list[list[dict[str, Any]]], kind: str = "rgb.png"
) -> Path:
    with tarfile.open(path, "w") as archive:
        for key, shown, pixels in zip(keys, truths, PIXELS, strict=False):
            image = cv2.imencode("." + kind.split(".")[1], pixels)[1].tobytes()
            parts = {kind: image, "gt.json": json.dumps(shown).encode(),
                     "camera.json": json.dumps({"cam_K": K, "depth_scale": 1.0}).encode(),
                     "mask.json": b"{}"}  # fmt: skip
            for name, content in parts.items():
                member = tarfile.TarInfo(f"{key}.{name}")
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
    return path


@pytest.mark.parametrize("kind", ["rgb.png", "gray.png", "gray.tif"])
@pytest.mark.parametrize(
    ("keys", "numbers"),
    [
        (["000001_000004", "000001_000007"], [4, 7]),
        (["4", "7"], [4, 7]),
        (["./shard/0004", "./shard/0007"], [4, 7]),
        (["000001_000004", "000002_000004"], [0, 1]),
        (["first", "second"], [0, 1]),
    ],
)
def test_frames_of_a_shard(tmp_path: Path, kind: str, keys: list[str], numbers: list[int]) -> None:
    path = write_shard(tmp_path / "shard-000000.tar", keys, [[truth()], [truth(z=5000.0)]], kind)
    sequence = open_sequence(path)
    assert [frame.im_id for frame in sequence] == numbers
    assert [frame.camera for frame in sequence] == [PLAIN, PLAIN]
    assert [frame.obj_id for frame in sequence] == [5, 5]
    assert [f.camera_from_target.translation_m[2] for f in sequence] == [4.0, 5.0]
    for frame, pixels in zip(sequence, PIXELS, strict=False):
        np.testing.assert_array_equal(frame.read(), pixels)


def test_several_instances_have_no_truth_and_are_counted(tmp_path: Path) -> None:
    shown = [[truth(), truth(z=5000.0), truth(7)], [truth(), truth(7)]]
    path = write_shard(tmp_path / "a.tar", ["0", "1"], shown)
    with pytest.raises(RendezviewError, match="several objects"):
        open_sequence(path)
    sequence = open_sequence(path, obj_id=5)
    assert [frame.camera_from_target is None for frame in sequence] == [True, False]
    assert "1 of 2 frames show the target several times" in " ".join(sequence.notes)


def test_what_is_no_shard_is_named(tmp_path: Path) -> None:
    path = write_shard(tmp_path / "a.tar", ["0", "1"], [[], []], "depth.png")
    with pytest.raises(RendezviewError, match=r"a\.tar: no pictures of a BOP shard"):
        open_sequence(path)
    path.write_bytes(b"\x1f\x8bno tar")
    with pytest.raises(RendezviewError, match="not a tar file that can be read"):
        open_sequence(path)
    whole = write_shard(path, ["0", "1"], [[], []]).read_bytes()
    path.write_bytes(whole[: len(whole) // 3])
    with pytest.raises(RendezviewError, match=r"not a tar file|cut short|0 has no camera"):
        open_sequence(path)
