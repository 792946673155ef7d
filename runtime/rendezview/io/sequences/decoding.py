"""Encoded pictures (PNG, JPEG …) to grey levels."""

from __future__ import annotations

import contextlib
import struct
import threading
import zlib
from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.io.sequences.frame import GreyImage

PNG = b"\x89PNG\r\n\x1a\n"  # first bytes of a file

# A picture rotated by its EXIF tag does not fit its calibration.
_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
_ANIMATED = (b"acTL", b"fcTL", b"fdAT")

Bytes = bytes | bytearray | memoryview | npt.NDArray[np.uint8]


@contextlib.contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's own messages: our error describes the fault. Threads may overlap."""
    _silence.enter()
    try:
        yield
    finally:
        _silence.leave()


class _Silence:
    """OpenCV's log level, which is global: the first thread silences it, the last restores it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = 0
        self._level = 0

    def enter(self) -> None:
        with self._lock:
            if self._threads == 0:
                self._level = cv2.utils.logging.getLogLevel()
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            self._threads += 1

    def leave(self) -> None:
        with self._lock:
            self._threads -= 1
            if self._threads == 0:
                cv2.utils.logging.setLogLevel(self._level)


_silence = _Silence()


def decode_grey(content: Bytes) -> GreyImage | None:
    """A PNG, JPEG … as grey uint8 (height, width), as stored: not rotated by its EXIF tag.

    None if it is damaged, cut short, animated, or not a picture. The checksums of a PNG are checked
    first, because OpenCV's decoder can hang over a damaged one.
    """
    if len(content) == 0:
        return None
    data = np.frombuffer(content, dtype=np.uint8)
    if data[: len(PNG)].tobytes() == PNG and not _png_is_whole(data.data):
        return None
    try:
        with quiet_opencv():
            image = cv2.imdecode(data, _AS_STORED)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _png_is_whole(view: memoryview) -> bool:
    """Whether all chunks have the right checksum, and there is a single picture."""
    place = len(PNG)
    while place + 12 <= len(view):
        length, kind = struct.unpack(">I4s", view[place : place + 8])
        end = place + 12 + length
        if end > len(view) or kind in _ANIMATED:
            return False
        (checksum,) = struct.unpack(">I", view[end - 4 : end])
        if zlib.crc32(view[place + 4 : end - 4]) != checksum:
            return False
        if kind == b"IEND":
            return True  # what follows is not read
        place = end
    return False
