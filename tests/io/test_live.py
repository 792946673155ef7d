"""A network camera: a real stream of JPEG pictures over HTTP, from a thread of the test."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from tests.mjpeg_stream import mjpeg_stream

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import live
from rendezview.io.sequences.live import live_frames, why_unreachable, without_password

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


@pytest.fixture
def address() -> Iterator[str]:
    """Eight pictures a connection, each brighter than the last; then the connection breaks."""
    pictures = [np.full((48, 64), 10 * k, np.uint8) for k in range(1, 26)]
    with mjpeg_stream(pictures, 8) as address:
        yield address


def test_a_stream_that_breaks_off_is_opened_again_and_its_times_rise(address):
    notes: list[str] = []
    frames = live_frames(address, CAMERA, notes.append, every=True)
    taken = list(itertools.islice(frames, 12))
    greys = [float(frame.read().mean()) for frame in taken]
    assert greys == sorted(greys)
    assert greys[-1] >= 90.0  # of the second connection
    times = [frame.time_s for frame in taken]
    assert times == sorted(set(times))
    assert len(notes) == 1
    assert "broke off after" in notes[0]
    assert "word" not in notes[0] + taken[0].name


def test_a_slow_reader_gets_the_newest_picture_and_numbers_count_all_that_came():
    pictures = [np.full((48, 64), 10 * k, np.uint8) for k in range(1, 21)]
    with mjpeg_stream(pictures, len(pictures), pause_s=0.05) as address:
        frames = live_frames(address, CAMERA)
        taken = []
        for _ in range(4):
            frame = next(frames)
            taken.append((frame.im_id, frame.time_s, round(float(frame.read().mean()) / 10.0) - 1))
            time.sleep(0.22)
        frames.close()
    assert [number for number, _, _ in taken] == [grey for _, _, grey in taken]
    apart = np.diff([number for number, _, _ in taken])
    assert np.all(apart >= 2)  # four each; waiting in a buffer they would be one apart
    assert np.all(np.diff([time_s for _, time_s, _ in taken]) > 0.09)


def test_the_last_picture_is_given_and_an_error_is_the_readers():
    assert list(live._newest(iter([5])))[-1] == 5
    given = live._newest(1 // k for k in (1, 0))
    with pytest.raises(ZeroDivisionError):
        list(given)


def test_pictures_of_another_size_than_the_calibration_are_refused(address):
    with pytest.raises(RendezviewError, match="its pictures are 64 × 48, the camera file is for"):
        next(live_frames(address, Camera(80, 48, 60.0, 60.0, 39.5, 23.5)))


def test_a_stream_that_does_not_come_back_is_an_error(address, monkeypatch):
    monkeypatch.setattr(live, "AGAIN_S", 0.0)
    frames = live_frames(address, CAMERA)
    next(frames)
    monkeypatch.setattr(live, "_opened", lambda _: cv2.VideoCapture())
    with pytest.raises(RendezviewError, match="cannot be opened again"):
        list(frames)


def test_why_a_stream_is_out_of_reach_is_told_without_its_password():
    assert "refused" in why_unreachable("rtsp://127.0.0.1:9/live")
    assert why_unreachable("tcp://127.0.0.1/live") == "the address has no port"
    assert without_password("rtsp://me:secret@host/1") == "rtsp://host/1"
