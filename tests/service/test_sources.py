"""What `serve --source` reads: recordings of others give the frames that are in them."""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from tests.io.bags import START_S, Shot, write_foxglove, write_ros1, write_ros2
from tests.mjpeg_stream import mjpeg_stream

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.sequences import open_sequence
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_service.hub.service import Service
from rendezview_service.hub.source_process import SourceProcess
from rendezview_service.hub.sources import SourceFrame, open_source
from rendezview_service.settings import Settings

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
    frames = list(source.frames)
    assert len(frames) == 4
    for k, frame in enumerate(frames):
        assert isinstance(frame, SourceFrame)
        assert frame.time_s == pytest.approx(START_S + 0.5 * k)
        assert frame.content == images[k].tobytes()


@pytest.fixture
def network_camera() -> Iterator[str]:
    """Grey levels that rise by 10 from frame to frame, as MJPEG; it breaks off after 30."""
    pictures = [np.full((48, 64), 20 + 10 * (k % 20), np.uint8) for k in range(30)]
    with mjpeg_stream(pictures, 30, pause_s=0.01) as address:
        yield address


def test_a_network_stream_is_opened_again_when_it_breaks_off(network_camera, monkeypatch) -> None:
    monkeypatch.setattr("rendezview_service.hub.sources.RECONNECT_S", 0.05)
    with pytest.raises(RendezviewError, match="--camera"):
        open_source(network_camera, None)
    source = open_source(network_camera, CAMERA)
    assert source.live
    assert "word" not in source.name
    seen: list[float] = []
    breaks: list[str] = []
    for got in itertools.islice(source.frames, 70):
        if isinstance(got, RendezviewError):
            breaks.append(str(got))
            continue
        assert got.time_s is None  # that of its arrival
        grey = np.frombuffer(got.content, np.uint8)
        assert grey.size == 48 * 64
        seen.append(float(grey.mean()))
        if len(breaks) == 2:
            break
    assert len(breaks) == 2
    assert all("broke off" in told and "word" not in told for told in breaks)
    assert len(seen) >= 40  # the first of a connection may be lost in opening it
    steps = np.diff(seen)
    assert np.median(steps) == pytest.approx(10.0, abs=1.0)


def test_a_network_stream_that_is_not_there_is_tried_again(monkeypatch) -> None:
    monkeypatch.setattr("rendezview_service.hub.sources.RECONNECT_S", 0.05)
    source = open_source("http://127.0.0.1:9/nothing", CAMERA)
    first, second = itertools.islice(source.frames, 2)
    assert isinstance(first, RendezviewError)
    assert "cannot be opened" in str(first)
    assert isinstance(second, RendezviewError)


def test_why_a_source_cannot_be_opened_is_said(monkeypatch) -> None:
    monkeypatch.setattr("rendezview_service.hub.sources.RECONNECT_S", 0.05)
    for name, why in (
        ("http://127.0.0.1:9/nothing", "Connection refused"),
        ("http://no-such-host.invalid/x", "no such host"),
        ("/dev/video97", "no such camera"),
    ):
        first = next(open_source(name, CAMERA).frames)
        assert isinstance(first, RendezviewError)
        assert why in str(first)


def _scene(folder: Path, count: int) -> list[np.ndarray]:
    images = [np.full((48, 64), (10 * k) % 250, np.uint8) for k in range(count)]
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k:03}.png"), image)
    return images


def test_a_source_is_decoded_in_a_process_of_its_own(tmp_path: Path) -> None:
    images = _scene(tmp_path, 5)
    source = SourceProcess(str(tmp_path), CAMERA)
    assert (source.camera, source.live) == (CAMERA, False)
    frames = list(source.frames())
    assert [frame.content for frame in frames] == [image.tobytes() for image in images]
    source.close()
    with pytest.raises(RendezviewError, match="nowhere"):
        SourceProcess(str(tmp_path / "nowhere"), CAMERA)


def test_a_decoder_that_ends_is_said_and_a_live_one_is_started_again(
    tmp_path: Path, network_camera, monkeypatch
) -> None:
    monkeypatch.setattr("rendezview_service.hub.source_process.RECONNECT_S", 0.05)
    _scene(tmp_path, 300)
    file = SourceProcess(str(tmp_path), CAMERA)
    frames = file.frames()
    next(frames)
    _kill_children()
    with pytest.raises(RendezviewError, match=r"did not answer|ended"):
        list(frames)
    file.close()
    live = SourceProcess(network_camera, CAMERA)
    got = live.frames()
    assert isinstance(next(got), SourceFrame)
    _kill_children()
    said = (isinstance(each, RendezviewError) and "starting again" in str(each) for each in got)
    assert any(itertools.islice(said, 200))
    live.close()


def test_a_live_source_that_does_not_start_again_is_tried_once_more(
    network_camera, monkeypatch
) -> None:
    monkeypatch.setattr("rendezview_service.hub.source_process.RECONNECT_S", 0.05)
    live = SourceProcess(network_camera, CAMERA)
    start, tries = live._start, []

    def fails_once() -> object:
        tries.append(len(tries))
        if len(tries) == 1:
            raise RendezviewError("no memory")
        return start()

    monkeypatch.setattr(live, "_start", fails_once)
    got = live.frames()
    next(got)
    _kill_children()
    frames = (each for each in got if len(tries) > 1 and isinstance(each, SourceFrame))
    next(frames)
    live.close()
    assert tries == [0, 1]


def _kill_children() -> None:
    """The decoders' processes of this one, as a crash ends them."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    for pid in map(int, children):
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
        if b"source_process" in command:
            os.kill(pid, signal.SIGSEGV)


def test_what_is_odd_about_a_source_comes_with_it(tmp_path: Path) -> None:
    narrow = Camera(64, 48, 6000.0, 6000.0, 31.5, 23.5)  # of 0.6 degrees
    with BopSceneWriter(tmp_path / "scene", narrow) as writer:
        writer.add(0, np.zeros((48, 64), np.uint8), Pose(np.eye(3), [0.0, 0.0, 9.0]), 0.0)
    source = SourceProcess(str(tmp_path / "scene"), None)
    try:
        assert source.notes == list(open_sequence(tmp_path / "scene").notes)
        assert any("the field of view is 0.6" in note for note in source.notes)
    finally:
        source.close()


def test_a_source_whose_driver_keeps_its_process_holds_up_no_other_session(model_path) -> None:
    service, wakes = Service(Settings(), model_path), []
    session = SimpleNamespace(id="main", worker=None, keeper=None, end=lambda *_: None)
    service.sessions["main"] = session
    service._fed["main"] = SimpleNamespace(close=lambda: time.sleep(0.5))

    async def close() -> None:
        closing = asyncio.create_task(service.close(session, "closed"))
        wakes.append(time.monotonic())
        while not closing.done():
            await asyncio.sleep(0.01)
            wakes.append(time.monotonic())

    asyncio.run(close())
    assert max(np.diff(wakes)) < 0.4
