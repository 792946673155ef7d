"""Frames as they arrive: raw, PNG or JPEG, with their size checked before they are decoded.

The headers are read here. The package ``imagesize`` reads them too, but takes 55 to 85 µs per frame
(here 1 to 3 µs; 640 × 480 PNG and JPEG) and does not check the header's checksum.
"""

from __future__ import annotations

import struct
import zlib
from enum import StrEnum

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.decoding import JPEG, PNG, decode_grey
from rendezview.io.sequences.frame import GreyImage

_MOST_SEGMENTS = 1000  # of a JPEG before its size is known. Source: a chosen limit
# JPEG markers without a length; those of a frame header. Source: ITU-T T.81 table B.1.
_BARE_MARKERS = (0x01, *range(0xD0, 0xDA))
# Source: ITU-T T.81 table B.1.
_SIZE_MARKERS = tuple(m for m in range(0xC0, 0xD0) if m not in (0xC4, 0xC8, 0xCC))

# Bytes of a file beyond those of a pixel: texts, colour profiles, small previews. And of a pixel:
# a PNG has at most four levels of 16 bits. Source: chosen limits; decoders read 5 ns a byte
_BESIDE_PIXELS, _OF_PIXEL = 1_000_000, 10

Bytes = bytes | bytearray | memoryview


class FrameKind(StrEnum):
    """Encoding of a frame."""

    RAW = "raw"
    PNG = "png"
    JPEG = "jpeg"


def longest_frame(width: int, height: int) -> int:
    """Bytes of the longest frame of a camera: with more, it is packed wastefully."""
    return _BESIDE_PIXELS + _OF_PIXEL * width * height


def kind_of(content: Bytes) -> FrameKind:
    """PNG or JPEG by the first bytes; anything else is raw grey levels."""
    start = bytes(content[:8])
    if start == PNG:
        return FrameKind.PNG
    return FrameKind.JPEG if start[:3] == JPEG else FrameKind.RAW


def read_frame(content: Bytes, camera: Camera) -> GreyImage:
    """The grey image, uint8 (height, width) of the camera.

    An image of another size is refused before it is decoded, so that a small file cannot allocate
    much memory.

    Raises:
        RendezviewError: it has another size, is cut short, or is not an image.
    """
    kind = kind_of(content)
    if kind is FrameKind.RAW:
        wanted = camera.width * camera.height
        if len(content) != wanted:
            raise RendezviewError(
                f"a raw frame of this camera has {camera.width} × {camera.height} = {wanted} "
                f"bytes, not {len(content)}: send grey levels row by row, or a PNG or JPEG file"
            )
        # A copy: the next frame comes in the same memory. Writable, like all frames: numba compiles
        # read-only arrays separately, and the two compilations may round differently.
        levels = np.frombuffer(bytearray(content), dtype=np.uint8)
        return levels.reshape(camera.height, camera.width)
    damaged = (
        f"the {kind.upper()} frame is cut short or damaged, or packed wastefully: send it again"
    )
    if len(content) > longest_frame(camera.width, camera.height):
        raise RendezviewError(damaged)
    size = png_size(content) if kind is FrameKind.PNG else jpeg_size(content)
    if size is None or (kind is FrameKind.JPEG and b"\xff\xd9" not in bytes(content[-64:])):
        raise RendezviewError(damaged)
    if size != (camera.width, camera.height):
        raise RendezviewError(
            f"the frame is {size[0]} × {size[1]} pixels but the camera has {camera.width} × "
            f"{camera.height}: send frames of the session's camera"
        )
    image = decode_grey(content, camera.bit_depth or 16)
    if image is None or image.shape != (camera.height, camera.width):
        raise RendezviewError(damaged)
    return image


def png_size(content: Bytes) -> tuple[int, int] | None:
    """Width and height in a PNG header; None if the header is damaged."""
    if len(content) < 33 or bytes(content[12:16]) != b"IHDR":
        return None
    width, height, checksum = struct.unpack(">II5xI", content[16:33])
    if zlib.crc32(content[12:29]) != checksum:
        return None
    return width, height


def jpeg_size(content: Bytes) -> tuple[int, int] | None:
    """Width and height in a JPEG frame header; None if there is none."""
    place = 2
    for _ in range(_MOST_SEGMENTS):
        if place + 4 > len(content):
            return None
        if content[place] != 0xFF:
            return None
        marker = content[place + 1]
        if marker == 0xFF:  # fill byte
            place += 1
            continue
        if marker in _BARE_MARKERS:
            place += 2
            continue
        (length,) = struct.unpack(">H", content[place + 2 : place + 4])
        if marker in _SIZE_MARKERS:
            if place + 9 > len(content):
                return None
            height, width = struct.unpack(">HH", content[place + 5 : place + 9])
            return width, height
        if length < 2 or marker == 0xDA:
            return None
        place += 2 + length
    return None
