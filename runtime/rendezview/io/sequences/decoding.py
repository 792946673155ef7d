"""Encoded pictures (PNG, JPEG …) to grey levels."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.io.grey_frame import eight_bits
from rendezview.io.sequences.frame import GreyImage
from rendezview.io.sequences.picture import AS_STORED
from rendezview.io.sequences.picture_marks import marks_of, tiff_as_stored
from rendezview.io.sequences.quiet import quiet_opencv

PNG = b"\x89PNG\r\n\x1a\n"  # first bytes of a file
JPEG = b"\xff\xd8\xff"
_SCAN = b"\xff\xda"  # marker of a scan: in packed data 0xff is followed by other bytes
# Each scan is a pass over the picture; libjpeg's own files have 6 (grey) or 10.
# Source: a chosen limit.
_MOST_SCANS = 64
_SURPLUS = 65_536  # bytes that a PNG may unpack to beyond its picture. Source: a chosen limit
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # a pixel, by colour type. Source: PNG, table 11.1
# Chunks that are given to the decoder: it would apply others to the levels (gAMA, sRGB: up to 65 of
# 255 where colour becomes grey), or unpack them (texts, profiles).
_DECODED = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
# Chunks of a PNG beyond one per KiB of the file; libpng's own have 8 KiB. Source: a chosen limit
_MOST_CHUNKS = 1000
_AT_ONCE = 1 << 20  # bytes that are unpacked at once. Source: chosen
_INTERLACED_ROWS = 8  # filter bytes a row and pass, at most. Source: PNG, section 8.2

_TIFF = (b"II*\0", b"MM\0*")
_WITH_ALPHA = (b"\x89PNG", b"RIFF")
_ANIMATED = (b"acTL", b"fcTL", b"fdAT")

Levels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]  # grey, (height, width), as stored
Bytes = bytes | bytearray | memoryview | npt.NDArray[np.uint8]


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


def decode_levels(content: Bytes) -> Levels | None:
    """A PNG, JPEG … as grey levels of 8 or 16 bits, as stored: not rotated by its EXIF tag.

    Gamma and profiles are not applied. What is transparent lies over black.

    None if it is damaged, cut short, animated, of floating-point levels, or not a picture; or if
    a small file would cost much time: a JPEG of hundreds of scans, a PNG of many thousand chunks or
    one that unpacks to more than its picture. The checksums of a PNG are checked first, because
    OpenCV's decoder can hang over a damaged one.
    """
    if len(content) == 0:
        return None
    data = np.frombuffer(content, dtype=np.uint8)
    start = data[: len(PNG)].tobytes()
    if start == PNG:
        plain = _plain_png(data.data)
        if plain is None:
            return None
        data = np.frombuffer(plain, dtype=np.uint8)
    if start[:4] in _TIFF:
        data = np.frombuffer(tiff_as_stored(data.tobytes()), dtype=np.uint8)
    if start[:3] == JPEG and data.tobytes().count(_SCAN) > _MOST_SCANS:
        return None
    try:
        with quiet_opencv():
            image = cv2.imdecode(data, AS_STORED)
            if image is None or image.dtype not in (np.uint8, np.uint16):
                return None
            if start[:4] in _WITH_ALPHA and marks_of(data.tobytes()).transparent:
                image = _over_black(image, cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    except cv2.error:
        return None
    return image  # type: ignore[return-value]  # its type was checked


def is_animated(content: bytes) -> bool:
    """Whether a PNG holds several pictures."""
    return content.startswith(PNG) and content[:_AT_ONCE].find(_ANIMATED[0]) > 0


def _over_black(grey: npt.NDArray[Any], whole: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
    """Grey levels with the transparency of the whole picture."""
    if whole is None or whole.ndim != 3 or whole.shape[2] != 4 or whole.dtype != grey.dtype:
        return grey
    alpha, most = whole[:, :, 3], np.iinfo(grey.dtype).max
    if (alpha == most).all():
        return grey
    dimmed: npt.NDArray[Any] = (grey.astype(np.uint64) * alpha + most // 2) // most
    return dimmed.astype(grey.dtype)


def _plain_png(view: memoryview) -> bytes | None:
    """The chunks that are decoded; None if a checksum is wrong, or there is no single picture."""
    place = len(PNG)
    kept = [bytes(view[:place])]
    pixels: _Unpacked | None = None
    for _ in range(_MOST_CHUNKS + len(view) // 1024):
        if place + 12 > len(view):
            return None
        length, kind = struct.unpack(">I4s", view[place : place + 8])
        end = place + 12 + length
        if end > len(view) or kind in _ANIMATED:
            return None
        (checksum,) = struct.unpack(">I", view[end - 4 : end])
        if zlib.crc32(view[place + 4 : end - 4]) != checksum:
            return None
        content = view[place + 8 : end - 4]
        if kind == b"IHDR" and length == 13:
            pixels = _Unpacked.of(bytes(content))
        elif kind == b"IDAT" and (pixels is None or not pixels.takes(content)):
            return None
        if kind in _DECODED:
            kept.append(bytes(view[place:end]))
        if kind == b"IEND":
            return b"".join(kept)  # what follows is not read
        place = end
    return None


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
