"""Sources that the service reads itself: image sequences, logs, cameras, network streams.

Their decoders run in a process of their own: `source_process`.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import Sequence, open_sequence
from rendezview.io.sequences.live import is_live, live_frames, without_password

_V4L2 = re.compile(r"^v4l2:(?=\d+$)")
RECONNECT_S = 2.0  # s, before a live source is opened again. Source: chosen


@dataclass(frozen=True)
class SourceFrame:
    """A frame of a source, in the bytes that a client would send."""

    time_s: float | None  # None: the time of arrival
    content: bytes


Coming = Iterator[SourceFrame | RendezviewError]  # frames, and why one is not there


@dataclass(frozen=True, eq=False)
class Source:
    """A name, a camera and the frames to come."""

    name: str
    camera: Camera | None
    live: bool  # True: only the newest frame counts; False: every frame
    frames: Coming
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
        return Source(without_password(text), camera, True, _live(text, camera))
    if text.endswith(".mcap"):
        from rendezview_service.logs.replay import read_log  # imports the trackers

        log = read_log(Path(text))
        if log.notes:  # a log of the service: its frames as they were sent
            return Source(text, camera or log.camera, False, _logged(log.frames()))
    sequence = open_sequence(text, camera)
    first = sequence.frames[0].camera if sequence.frames else camera
    return Source(text, first, False, _stored(sequence), notes=sequence.notes)


def _live(text: str, camera: Camera) -> Coming:
    """Frames of a camera or a network stream; opens it again after a failure."""

    def broke_off(said: str) -> None:
        raise RendezviewError(said)  # is reported at once

    while True:
        try:
            for frame in live_frames(text, camera, broke_off):
                yield SourceFrame(None, frame.read().tobytes())
        except RendezviewError as error:
            yield error
        time.sleep(RECONNECT_S)


def _logged(frames: Iterator[Any]) -> Coming:
    last_s = -math.inf
    for frame in frames:
        if frame.image is not None and frame.time_s > last_s:
            last_s = frame.time_s
            yield SourceFrame(frame.time_s, frame.image)


def _stored(sequence: Sequence) -> Coming:
    for index, frame in enumerate(sequence):
        try:
            content = frame.read().tobytes()
        except RendezviewError as error:
            yield error
        else:
            yield SourceFrame(float(index) if frame.time_s is None else frame.time_s, content)
