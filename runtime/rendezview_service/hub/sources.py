"""Sources that the service reads itself: image sequences, logs, cameras, network streams.

Their decoders run in a process of their own: `source_process`.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.live import is_live, live_frames, without_password

_V4L2 = re.compile(r"^v4l2:(?=\d+$)")
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
    notes: tuple[str, ...] = ()  # what is odd about its frames, their times and their camera


def open_source(text: str, camera: Camera | None) -> Source:
    """A source by its name: path, ``/dev/video0``, ``v4l2:0``, ``rtsp://…``, ``bag#/topic``.

    Raises:
        RendezviewError: it does not exist, or needs a camera file.
    """
    text = _V4L2.sub("/dev/video", text)
    if is_live(text):
        if camera is None:
            raise RendezviewError(f"{text}: its calibration is not known: give --camera")
        return Source(without_password(text), camera, True, lambda stop: _live(text, camera, stop))
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


def _live(
    text: str, camera: Camera, stop: threading.Event
) -> Iterator[SourceFrame | RendezviewError]:
    """Frames of a camera or a network stream; opens it again after a failure."""

    def broke_off(said: str) -> None:
        raise RendezviewError(said)  # is reported at once

    while not stop.is_set():
        try:
            for frame in live_frames(text, camera, broke_off):
                if stop.is_set():
                    return
                yield SourceFrame(None, frame.read().tobytes())
        except RendezviewError as error:
            yield error
        stop.wait(RECONNECT_S)


def _logged(frames: Iterator[Any]) -> Iterator[SourceFrame | RendezviewError]:
    last_s = -math.inf
    for frame in frames:
        if frame.image is not None and frame.time_s > last_s:
            last_s = frame.time_s
            yield SourceFrame(frame.time_s, frame.image)
