"""What `serve --source` reads: recordings of others give the frames that are in them."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from tests.bags import START_S, Shot, write_foxglove, write_ros1, write_ros2

from rendezview.camera import Camera
from rendezview.errors import RendezviewError
from rendezview.service.sources import SourceFrame, open_source

CAMERA = Camera.from_fov(64, 48, 1.0)


@pytest.mark.parametrize(
    ("write", "name"), [(write_ros1, "a.bag"), (write_ros2, "a"), (write_foxglove, "a.mcap")]
)
def test_a_recording_is_a_source(tmp_path: Path, write, name: str) -> None:
    images = np.random.default_rng(71).integers(0, 255, (6, 48, 64), dtype=np.uint8)
    shots = [
        Shot(im, 0.5 * k, "/a/image_raw" if k < 4 else "/b/image") for k, im in enumerate(images)
    ]
    path = write(tmp_path / name, shots, {"/a/camera_info": CAMERA})
    with pytest.raises(RendezviewError, match="several topics"):
        open_source(str(path), None)
    source = open_source(f"{path}#/a/image_raw", None)
    assert (source.camera, source.live) == (CAMERA, False)
    frames = list(source.frames(threading.Event()))
    assert len(frames) == 4
    for k, frame in enumerate(frames):
        assert isinstance(frame, SourceFrame)
        assert frame.time_s == pytest.approx(START_S + 0.5 * k)
        assert frame.content == images[k].tobytes()
