"""Frames of a camera as they come: a device's number, its path, or a stream's address."""

from __future__ import annotations

import errno
import math
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar
from urllib.parse import urlsplit

import cv2
import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import Frame, GreyImage, Sequence, grey_of
from rendezview.io.sequences.quiet import quiet_opencv

T = TypeVar("T")

_STREAM = re.compile(r"(rtsps?|rtmp|https?|udp|tcp)://.+", re.IGNORECASE)
_TIMED = re.compile(r"(rtsps?|udp)://.+", re.IGNORECASE)  # pictures come with the sender's times
_DEVICES = Path("/dev")
_TRIES = 30  # frames in a row that do not come, at most: a second. Source: by construction
_STALE = 5  # pictures in a row of one time: the stream has no times. Source: chosen
_SILENT_MS = 5000  # ms without a packet: the stream is broken. Source: chosen; OpenCV's own is 30 s
AGAIN_S = 10.0  # s, for so long a stream that broke off is opened again. Source: chosen
_PAUSE_S = 1.0  # s, between two attempts. Source: chosen
_REACH_S = 3.0  # s, to reach a network source, for the reason of a failure. Source: chosen
_PORTS = {"rtsp": 554, "rtsps": 322, "rtmp": 1935, "http": 80, "https": 443}


def is_live(source: str) -> bool:
    """Whether a text names a camera: ``0``, ``/dev/video0``, ``rtsp://…``; a path wins."""
    if source.startswith("/dev/video") or _STREAM.fullmatch(source):
        return True
    return source.isdigit() and not Path(source).exists()


def live_frames(
    source: str,
    camera: Camera | None,
    note: Callable[[str], None] = lambda _: None,
    *,
    every: bool = False,
) -> Generator[Frame, None, None]:
    """Frames of a camera for as long as they come; times in seconds from the first.

    Each is the newest: those that come while its reader is busy are left out, else they would wait
    in the camera's buffers and be answered late. Their numbers count all that came.

    A network stream that breaks off is opened again. Its times are the sender's where the
    protocol has them (RTSP, MPEG over UDP), so that a reading that takes long does not change
    them; else the times of arrival.

    Args:
        source: of `is_live`.
        camera: its calibration.
        note: is given a line when a stream breaks off.
        every: no frame is left out, as from a stored video at a network address: pictures that
            belong in pairs want that.

    Raises:
        RendezviewError: no calibration, the camera cannot be opened, its pictures are not the
            calibration's, or it stops.
    """
    capture = _opened(source)
    if not capture.isOpened():
        raise RendezviewError(_not_opened(source))
    if camera is None:
        capture.release()
        raise RendezviewError(
            f"{without_password(source)}: this camera has no camera file: make one with "
            "`rendezview calibrate camera` and give it with --camera"
        )
    if not _STREAM.fullmatch(source):
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
    return _frames(capture, source, camera, note, every)


def _opened(source: str) -> cv2.VideoCapture:
    with quiet_opencv():
        if source.isdigit():
            return cv2.VideoCapture(int(source))
        if not _STREAM.fullmatch(source):
            return cv2.VideoCapture(source)
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            _SILENT_MS,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            _SILENT_MS,
        ]
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)


def _not_opened(source: str) -> str:
    """Why a camera does not open, as far as can be seen: on Linux each is a file."""
    if _STREAM.fullmatch(source):
        return (
            f"{without_password(source)}: this camera cannot be opened: {why_unreachable(source)}"
        )
    device = Path(f"/dev/video{source}" if source.isdigit() else source)
    if sys.platform == "linux" and device.parent == _DEVICES and not device.exists():
        others = sorted(str(path) for path in _DEVICES.glob("video*"))
        there = f"there are {', '.join(others)}" if others else "no camera is connected"
        return (
            f"{source}: no such camera ({device}): {there}; pictures can also come from a video, a "
            "folder or rtsp://…"
        )
    return (
        f"{source}: this camera cannot be opened: check its number or path, and that no other "
        "program uses it"
    )


def why_unreachable(address: str) -> str:
    """Why a network stream cannot be opened: OpenCV does not say."""
    try:
        parts = urlsplit(address)
        if parts.scheme.lower() == "udp" or not parts.hostname:
            return "no picture comes"
        port = parts.port or _PORTS.get(parts.scheme.lower())
        if port is None:
            return "the address has no port"
        with socket.create_connection((parts.hostname, port), _REACH_S):
            return "it answers, but not with a stream that can be read: check path and password"
    except socket.gaierror:
        return "there is no such host"
    except TimeoutError:
        return f"no answer within {_REACH_S:g} s"
    except OSError as error:
        said = errno.errorcode.get(error.errno or 0, "") if error.strerror is None else ""
        return error.strerror or said or str(error)
    except ValueError as error:
        return str(error)


def without_password(address: str) -> str:
    """An address as messages and logs show it."""
    return re.sub(r"//[^/@]*@", "//", address)


def _frames(
    capture: cv2.VideoCapture, source: str, camera: Camera, note: Callable[[str], None], every: bool
) -> Generator[Frame, None, None]:
    name, start_s, last_s, first = without_password(source), time.monotonic(), -1.0, 0
    try:
        while True:
            # A stored video at a network address ends.
            ends = bool(_STREAM.fullmatch(source)) and capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0
            pictures = _pictures(capture, bool(_TIMED.fullmatch(source)), start_s, first)
            with closing(pictures if every or ends else _newest(pictures)) as taken:
                for number, (image, time_s) in taken:
                    grey = grey_of(image)
                    _check_size(grey, camera, name)
                    last_s, first = max(time_s, last_s + 1e-6), number + 1
                    there = partial(np.asarray, grey)
                    yield Frame(number, f"{name}, frame {number}", last_s, camera, None, 1, there)
            if ends:
                return
            capture.release()
            if not _STREAM.fullmatch(source):
                raise RendezviewError(f"{name}: no more pictures come from this camera")
            note(f"{name}: broke off after {first} pictures; opening it again")
            capture = _again(source)
    finally:
        capture.release()


def _newest(pictures: Iterator[T]) -> Generator[T, None, None]:
    """The newest picture whenever one is asked for; the last one in any case."""
    come = threading.Condition()
    newest: list[T] = []
    failed: list[BaseException] = []
    more = wanted = True

    def take() -> None:
        nonlocal more
        try:
            for picture in pictures:
                with come:
                    newest[:] = [picture]
                    come.notify()
                    if not wanted:
                        break
        except BaseException as error:  # it belongs to the reader
            failed.append(error)
        with come:
            more = False
            come.notify()

    thread = threading.Thread(target=take, daemon=True)
    thread.start()
    try:
        while True:
            with come:
                come.wait_for(lambda: newest or not more)
                if not newest:
                    break
                picture = newest.pop()
            yield picture
    finally:
        wanted = False
        thread.join()  # a camera that is still read must not be closed
    if failed:
        raise failed[0]


def _pictures(
    capture: cv2.VideoCapture, timed: bool, start_s: float, number: int
) -> Generator[tuple[int, tuple[cv2.typing.MatLike, float]], None, None]:
    """Numbered pictures and their times, s after ``start_s`` (monotonic), until none comes."""
    missed, stale, first_s, first_ms, last_ms = 0, 0, 0.0, math.nan, -1.0
    while missed < _TRIES:
        good, image = capture.read()
        if not good:
            missed += 1
            continue
        missed, time_s = 0, time.monotonic() - start_s
        if timed and stale < _STALE:
            sent_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
            if sent_ms <= last_ms:  # OpenCV gives a stream's first picture the second one's time
                stale += 1
                continue
            if math.isnan(first_ms):
                first_s, first_ms = time_s, sent_ms
            stale, last_ms = 0, sent_ms
            time_s = first_s + 1e-3 * (sent_ms - first_ms)
        yield number, (image, time_s)
        number += 1


def _again(source: str) -> cv2.VideoCapture:
    """A stream opened again.

    Raises:
        RendezviewError: it cannot be for `AGAIN_S`.
    """
    until_s = time.monotonic() + AGAIN_S
    while True:
        capture = _opened(source)
        if capture.isOpened():
            return capture
        if time.monotonic() > until_s:
            raise RendezviewError(
                f"{without_password(source)}: no more pictures come from this camera, and for "
                f"{AGAIN_S:g} s it cannot be opened again: {why_unreachable(source)}"
            )
        time.sleep(_PAUSE_S)


def _check_size(image: GreyImage, camera: Camera, name: str) -> None:
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        raise RendezviewError(
            f"{name}: its pictures are {width} × {height}, the camera file is for {camera.width} × "
            f"{camera.height}: set the camera to that size, or calibrate it as it is"
        )


def with_rate(sequence: Sequence, rate_hz: float) -> Sequence:
    """A sequence whose frames come at a rate, where they have no times of their own.

    Raises:
        RendezviewError: the rate is not positive.
    """
    if not 0.0 < rate_hz < float("inf"):
        raise RendezviewError(f"--rate must be positive, not {rate_hz}")
    frames = tuple(
        replace(frame, time_s=index / rate_hz) if frame.time_s is None else frame
        for index, frame in enumerate(sequence.frames)
    )
    return replace(sequence, frames=frames)
