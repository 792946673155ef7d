"""Sources that the service reads itself: image sequences, logs, cameras, network streams.

Their decoders run in a process of their own: `source_process`.
"""

from __future__ import annotations

import math
import os
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.live import why_unreachable, without_password
from rendezview.io.sequences.quiet import quiet_opencv

_LIVE = re.compile(r"(rtsps?|rtmp|udp|tcp|https?)://", re.IGNORECASE)
_DEVICE = re.compile(r"/dev/video\d+|v4l2:(\d+)")
RECONNECT_S = 2.0  # s, before a live source is opened again. Source: chosen


@dataclass(frozen=True)
class SourceFrame:
    """A frame of a source, in the bytes that a client would send."""

    time_s: float | None  # None: the time of arrival
    content: bytes


@dataclass(frozen=True, eq=False)
class Source:
    """A name, a camera and the frames to come."""

    name: str
    camera: Camera | None
    live: bool  # True: only the newest frame counts; False: every frame
    frames: Callable[[threading.Event], Iterator[SourceFrame | RendezviewError]]
    close: Callable[[], None] = lambda: None  # another thread may then wait for a frame no longer
    notes: tuple[str, ...] = ()  # what is odd about its frames, their times and their camera


def open_source(text: str, camera: Camera | None) -> Source:
    """A source by its name: path, ``/dev/video0``, ``v4l2:0``, ``rtsp://…``, ``bag#/topic``.

    Raises:
        RendezviewError: it does not exist, or needs a camera file.
    """
    if _LIVE.match(text) or _DEVICE.fullmatch(text):
        if camera is None:
            raise RendezviewError(f"{text}: its calibration is not known: give --camera")
        return Source(without_password(text), camera, True, lambda stop: _captured(text, stop))
    if text.endswith(".mcap"):
        from rendezview_service.logs.replay import read_log  # imports the trackers

        log = read_log(Path(text))
        if log.notes:  # a log of the service: its frames as they were sent
            return Source(text, camera or log.camera, False, lambda _: _logged(log.frames()))
    sequence = open_sequence(text, camera)

    def frames(stop: threading.Event) -> Iterator[SourceFrame | RendezviewError]:
        for index, frame in enumerate(sequence):
            try:
                content = frame.read().tobytes()
            except RendezviewError as error:
                yield error
                continue
            yield SourceFrame(float(index) if frame.time_s is None else frame.time_s, content)

    first = sequence.frames[0].camera if sequence.frames else camera
    return Source(text, first, False, frames, notes=sequence.notes)


def _captured(text: str, stop: threading.Event) -> Iterator[SourceFrame | RendezviewError]:
    """Frames of a camera or a network stream; opens it again after a failure."""
    device = _DEVICE.fullmatch(text)
    while not stop.is_set():
        with quiet_opencv():
            if device is not None:
                number = device[1] or text.removeprefix("/dev/video")
                capture = cv2.VideoCapture(int(number))
            else:
                capture = cv2.VideoCapture(text, cv2.CAP_FFMPEG)
        if not capture.isOpened():
            name, why = without_password(text), _why_not(text)
            yield RendezviewError(f"{name}: cannot be opened: {why}; trying again")
            stop.wait(RECONNECT_S)
            continue
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        while not stop.is_set():
            taken, image = capture.read()
            if not taken:
                yield RendezviewError(f"{without_password(text)}: broke off; opening it again")
                break
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield SourceFrame(None, grey.tobytes())
        capture.release()
        stop.wait(RECONNECT_S)


def _why_not(text: str) -> str:
    """Why a live source cannot be opened: OpenCV does not say."""
    device = _DEVICE.fullmatch(text)
    if device is None:
        return why_unreachable(text)
    try:
        path = f"/dev/video{device[1]}" if device[1] else text
        os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
        return "it is busy, or not a camera"
    except OSError as error:
        return error.strerror or str(error)


def _logged(frames: Iterator[Any]) -> Iterator[SourceFrame | RendezviewError]:
    last_s = -math.inf
    for frame in frames:
        if frame.image is not None and frame.time_s > last_s:
            last_s = frame.time_s
            yield SourceFrame(frame.time_s, frame.image)
