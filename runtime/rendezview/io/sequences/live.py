"""Frames of a camera as they come: a device's number, its path, or a stream's address."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.decoding import quiet_opencv
from rendezview.io.sequences.frame import Frame, GreyImage, Sequence

_STREAM = re.compile(r"(rtsp|rtsps|http|https|udp|tcp)://.+")
_DEVICES = Path("/dev")
_TRIES = 30  # frames in a row that do not come, at most: a second. Source: by construction


def is_live(source: str) -> bool:
    """Whether a text names a camera: ``0``, ``/dev/video0``, ``rtsp://…``; a path wins."""
    if source.startswith("/dev/video") or _STREAM.fullmatch(source):
        return True
    return source.isdigit() and not Path(source).exists()


def live_frames(source: str, camera: Camera | None) -> Iterator[Frame]:
    """Frames of a camera for as long as they come; times in seconds from the first.

    Args:
        source: of `is_live`.
        camera: its calibration.

    Raises:
        RendezviewError: no calibration, the camera cannot be opened, or it stops.
    """
    with quiet_opencv():
        capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
    if not capture.isOpened():
        raise RendezviewError(_not_opened(source))
    if camera is None:
        capture.release()
        raise RendezviewError(
            f"{source}: this camera has no camera file: make one with `rendezview calibrate "
            "camera` and give it with --camera"
        )
    if not _STREAM.fullmatch(source):
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
    return _frames(capture, source, camera)


def _not_opened(source: str) -> str:
    """Why a camera does not open, as far as can be seen: on Linux each is a file."""
    device = Path(f"/dev/video{source}" if source.isdigit() else source)
    if sys.platform == "linux" and device.parent == _DEVICES and not device.exists():
        others = sorted(str(path) for path in _DEVICES.glob("video*"))
        there = f"there are {', '.join(others)}" if others else "no camera is connected"
        return (
            f"{source}: no such camera ({device}): {there}; pictures can also come from a video, a "
            "folder or rtsp://…"
        )
    return (
        f"{source}: this camera cannot be opened: check its number or address, and that no other "
        "program uses it"
    )


def _frames(capture: cv2.VideoCapture, source: str, camera: Camera) -> Iterator[Frame]:
    start_s, last_s, number, missed = time.monotonic(), -1.0, 0, 0
    try:
        while True:
            good, image = capture.read()
            if not good:
                missed += 1
                if missed >= _TRIES:
                    raise RendezviewError(f"{source}: no more pictures come from this camera")
                continue
            missed, time_s = 0, max(time.monotonic() - start_s, last_s + 1e-6)
            last_s = time_s
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield Frame(
                number,
                f"{source}, frame {number}",
                time_s,
                camera,
                None,
                1,
                _Taken(np.asarray(grey, dtype=np.uint8)),
            )
            number += 1
    finally:
        capture.release()


class _Taken:
    """A picture that is there already."""

    def __init__(self, grey: GreyImage) -> None:
        self._grey = grey

    def __call__(self) -> GreyImage:
        return self._grey


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
