"""Sources that the service reads itself: image sequences, logs, cameras, network streams."""

from __future__ import annotations

import asyncio
import itertools
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import cv2

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.decoding import quiet_opencv
from rendezview.service.inputs import Answer
from rendezview.service.lease import SOURCE
from rendezview.service.replay import LoggedFrame, read_log
from rendezview.service.sessions import Session

_LIVE = re.compile(r"(rtsps?|rtmp|udp|tcp|https?)://", re.IGNORECASE)
_DEVICE = re.compile(r"/dev/video\d+|v4l2:(\d+)")
# s, between frames of a file; longer gaps are shortened. Source: a chosen limit.
_LONGEST_PAUSE_S = 10.0
_RECONNECT_S = 2.0  # s, before a live source is opened again. Source: chosen


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


def open_source(text: str, camera: Camera | None) -> Source:
    """A source by its name: path, ``/dev/video0``, ``v4l2:0``, ``rtsp://…``, ``bag#/topic``.

    Raises:
        RendezviewError: it does not exist, or needs a camera file.
    """
    if _LIVE.match(text) or _DEVICE.fullmatch(text):
        if camera is None:
            raise RendezviewError(f"{text}: its calibration is not known: give --camera")
        return Source(_without_password(text), camera, True, lambda stop: _captured(text, stop))
    if text.endswith(".mcap"):
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
    return Source(text, first, False, frames)


class Feeder:
    """A thread that gives the frames of a source to a session."""

    def __init__(
        self, source: Source, session: Session, loop: asyncio.AbstractEventLoop, speed: float
    ) -> None:
        """Files play at ``speed`` times their own rate; 0: without pauses."""
        self._source, self._session, self._loop, self._speed = source, session, loop, speed
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()

    def _run(self) -> None:
        reason: str | None = None
        try:
            last_s: float | None = None
            due_s = time.monotonic()
            for frame in self._source.frames(self._stop):
                if self._stop.is_set():
                    break
                if isinstance(frame, RendezviewError):
                    self._loop.call_soon_threadsafe(self._session.note_fault, str(frame))
                    continue
                if not self._source.live and self._speed > 0.0:
                    if last_s is not None and frame.time_s is not None:
                        pause_s = (frame.time_s - last_s) / self._speed
                        due_s = max(due_s + min(max(pause_s, 0.0), _LONGEST_PAUSE_S), 0.0)
                    last_s = frame.time_s
                    if self._stop.wait(max(0.0, due_s - time.monotonic())):
                        break
                self._give(frame)
        except RendezviewError as error:
            reason = str(error)
        except RuntimeError:
            return  # the loop is closed: the service has ended
        if not self._stop.is_set():
            self._loop.call_soon_threadsafe(self._session.source_ended, reason)

    def _give(self, frame: SourceFrame) -> None:
        done: Future[Answer] = Future()

        def answer(result: Answer) -> None:
            if not done.done():
                done.set_result(result)

        waiting = self._session.input((frame.content,), frame.time_s, answer, sender=SOURCE)
        self._loop.call_soon_threadsafe(self._session.replace, waiting)
        if not self._source.live:
            while not self._stop.is_set():
                try:
                    done.result(timeout=0.5)
                    return
                except TimeoutError:
                    continue


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
            yield RendezviewError(f"{_without_password(text)}: cannot be opened; trying again")
            stop.wait(_RECONNECT_S)
            continue
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        while not stop.is_set():
            taken, image = capture.read()
            if not taken:
                yield RendezviewError(f"{_without_password(text)}: broke off; opening it again")
                break
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield SourceFrame(None, grey.tobytes())
        capture.release()
        stop.wait(_RECONNECT_S)


def _logged(frames: Iterator[LoggedFrame]) -> Iterator[SourceFrame | RendezviewError]:
    last_s = -math.inf
    for frame in itertools.chain(frames):
        if frame.image is not None and frame.time_s > last_s:
            last_s = frame.time_s
            yield SourceFrame(frame.time_s, frame.image)


def _without_password(text: str) -> str:
    return re.sub(r"//[^/@]*@", "//", text)
