"""Compressed video in recordings: one picture of H.264 or H.265 in each message."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.io.sequences.quiet import quiet_opencv

_START = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)  # of a unit. Source: H.264, annex B
# Pictures that need none before them. Source: H.264, table 7-1, IDR; H.265, table 7-1, IRAP
_KEY_UNITS = {"h264": {5}, "h265": set(range(16, 24))}
_NAMES = {"hevc": "h265", "libx264": "h264", "libx265": "h265", "h264_nvenc": "h264"}
_MOST_BYTES = 2_000_000_000  # of one topic, which is held in memory. Source: a chosen limit


@dataclass(frozen=True, slots=True)
class VideoPart:
    """A message of a compressed video."""

    format: str  # as the message has it
    data: bytes | bytearray | memoryview | npt.NDArray[Any]

    @property
    def is_key(self) -> bool:
        """Whether its picture needs none before it.

        Raises:
            RendezviewError: another format than H.264 and H.265.
        """
        named = self.format.lower().split(";")[0]
        name = _NAMES.get(named, named)
        if name not in _KEY_UNITS:
            raise RendezviewError(
                f"video of format {self.format!r} is not read: record h264 or h265, or pictures"
            )
        units = (found[1][0] for found in _START.finditer(bytes(self.data)))
        kinds = {unit & 31 if name == "h264" else unit >> 1 & 63 for unit in units}
        return bool(kinds & _KEY_UNITS[name])


@dataclass(frozen=True, slots=True)
class VideoTopic:
    """The video of a topic from its first key picture; it can be sent to another process."""

    path: Path
    parts: Callable[[], Iterator[VideoPart]]

    def __str__(self) -> str:
        return str(self.path)

    def open(self) -> cv2.VideoCapture:
        """A decoder of the stream, at its start.

        Raises:
            RendezviewError: more than memory should hold.
        """
        stream = io.BytesIO()
        for part in self.parts():
            stream.write(bytes(part.data))
            if stream.tell() > _MOST_BYTES:
                raise RendezviewError(
                    f"{self.path}: its video has more than {_MOST_BYTES / 1e9:g} GB: split it"
                )
        stream.seek(0)
        with quiet_opencv():
            capture: cv2.VideoCapture = cv2.VideoCapture(stream, cv2.CAP_FFMPEG, [])  # type: ignore[call-overload]
        return capture
