"""Encoded pictures (PNG, JPEG …) to grey levels."""

from __future__ import annotations

import contextlib
import struct
import threading
import zlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.io.sequences.frame import GreyImage

PNG = b"\x89PNG\r\n\x1a\n"  # first bytes of a file
JPEG = b"\xff\xd8\xff"
_SCAN = b"\xff\xda"  # marker of a scan: in packed data 0xff is followed by other bytes
# Each scan is a pass over the picture; libjpeg's own files have 6 (grey) or 10.
# Source: a chosen limit.
_MOST_SCANS = 64
_SURPLUS = 65_536  # bytes that a PNG may unpack to beyond its picture. Source: a chosen limit
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # a pixel, by colour type. Source: PNG, table 11.1
# Chunks of a PNG beyond one per KiB of the file; libpng's own have 8 KiB. Source: a chosen limit
_MOST_CHUNKS = 1000
_PACKED_TEXT = (b"zTXt", b"iTXt", b"iCCP")  # chunks that are unpacked too
_MOST_PACKED_TEXT = 65_536  # bytes of them together. Source: a chosen limit
_AT_ONCE = 1 << 20  # bytes that are unpacked at once. Source: chosen
_INTERLACED_ROWS = 8  # filter bytes a row and pass, at most. Source: PNG, section 8.2

# A picture rotated by its EXIF tag does not fit its calibration.
# IMREAD_GRAYSCALE alone drops the low eight of 16 bits.
_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_ANIMATED = (b"acTL", b"fcTL", b"fdAT")

Levels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]  # grey, (height, width), as stored
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


def decode_grey(content: Bytes, bits: int = 16) -> GreyImage | None:
    """A PNG, JPEG … as grey uint8 (height, width), as stored: not rotated by its EXIF tag.

    Args:
        content: the file.
        bits: of 16-bit levels, those in use, counted from the lowest; the highest eight are kept.

    Returns:
        None as `decode_levels`.

    Raises:
        RendezviewError: a level needs more bits.
    """
    levels = decode_levels(content)
    return None if levels is None else eight_bits(levels, bits)


def eight_bits(levels: npt.NDArray[Any], bits: int) -> GreyImage:
    """Grey levels in eight bits, the highest of ``bits``.

    Raises:
        RendezviewError: a level needs more bits.
    """
    if levels.dtype == np.uint8:
        return np.asarray(levels, dtype=np.uint8)
    peak = int(levels.max(initial=0))
    if peak >= 1 << bits:
        raise RendezviewError(
            f"a level of {peak} needs more than {bits} bits: put the camera's bit_depth into the "
            "camera file"
        )
    return (levels >> (bits - 8)).astype(np.uint8)


def decode_levels(content: Bytes) -> Levels | None:
    """A PNG, JPEG … as grey levels of 8 or 16 bits, as stored: not rotated by its EXIF tag.

    None if it is damaged, cut short, animated, of floating-point levels, or not a picture; or if
    a small file would cost much time: a JPEG of hundreds of scans, a PNG of many thousand chunks
    or one that unpacks to more than its picture. The checksums of a PNG are checked first, because
    OpenCV's decoder can hang over a
    damaged one.
    """
    if len(content) == 0:
        return None
    data = np.frombuffer(content, dtype=np.uint8)
    start = data[: len(PNG)].tobytes()
    if start == PNG and not _png_is_whole(data.data):
        return None
    if start[:3] == JPEG and data.tobytes().count(_SCAN) > _MOST_SCANS:
        return None
    try:
        with quiet_opencv():
            image = cv2.imdecode(data, _AS_STORED)
    except cv2.error:
        return None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    return image  # type: ignore[return-value]  # its type was checked


def _png_is_whole(view: memoryview) -> bool:
    """Whether all chunks have the right checksum, and there is a single picture."""
    place, text_bytes = len(PNG), 0
    pixels: _Unpacked | None = None
    for _ in range(_MOST_CHUNKS + len(view) // 1024):
        if place + 12 > len(view):
            return False
        length, kind = struct.unpack(">I4s", view[place : place + 8])
        end = place + 12 + length
        if end > len(view) or kind in _ANIMATED:
            return False
        (checksum,) = struct.unpack(">I", view[end - 4 : end])
        if zlib.crc32(view[place + 4 : end - 4]) != checksum:
            return False
        content = view[place + 8 : end - 4]
        if kind == b"IHDR" and length == 13:
            pixels = _Unpacked.of(bytes(content))
        elif kind == b"IDAT" and (pixels is None or not pixels.takes(content)):
            return False
        elif kind in _PACKED_TEXT:
            text_bytes += length
            if text_bytes > _MOST_PACKED_TEXT:
                return False
        elif kind == b"IEND":
            return True  # what follows is not read
        place = end
    return False


class _Unpacked:
    """Counts the bytes of a PNG's picture as they are unpacked, without keeping them."""

    def __init__(self, most: int) -> None:
        self._left = most
        self._stream = zlib.decompressobj()

    @classmethod
    def of(cls, header: bytes) -> _Unpacked | None:
        """By an IHDR chunk; None for a colour type that does not exist."""
        width, height, depth, colour = struct.unpack(">IIBB", header[:10])
        if colour not in _SAMPLES:
            return None
        row = (width * depth * _SAMPLES[colour] + 7) // 8 + _INTERLACED_ROWS
        return cls(row * height + _SURPLUS)

    def takes(self, packed: memoryview) -> bool:
        """Whether the next IDAT chunk is whole so far, and not too much."""
        try:
            while packed and not self._stream.eof:
                out = self._stream.decompress(packed, min(self._left + 1, _AT_ONCE))
                self._left -= len(out)
                if self._left < 0:
                    return False
                packed = memoryview(self._stream.unconsumed_tail)
        except zlib.error:
            return False
        return True
