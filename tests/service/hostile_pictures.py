"""Pictures that their formats allow and that would cost a decoder much for their size."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.io.sequences.decoding import PNG

Grey = npt.NDArray[np.uint8]


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG with its checksum."""
    checksum = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)


def png(grey: Grey, packed: bytes, *more: bytes, piece: int = 40_000, interlaced: int = 0) -> bytes:
    """A PNG of 8-bit grey levels.

    Args:
        packed: its rows, deflated.
        more: chunks before the picture.
        piece: bytes of each IDAT chunk.
    """
    height, width = grey.shape
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, interlaced)
    pieces = [packed[k : k + piece] for k in range(0, len(packed), piece)]
    parts = [chunk(b"IHDR", header), *more, *(chunk(b"IDAT", part) for part in pieces)]
    return PNG + b"".join([*parts, chunk(b"IEND", b"")])


def rows_of(grey: Grey) -> bytes:
    """The rows of a PNG, each after its filter's number."""
    return b"".join(b"\x00" + row.tobytes() for row in grey)


def _stored(rows: bytes, empty: int) -> bytes:
    """Rows in deflate's stored blocks, after so many empty ones."""
    blocks = [rows[k : k + 65_535] for k in range(0, len(rows), 65_535)]
    last = len(blocks) - 1
    body = b"".join(
        struct.pack("<BHH", k == last, len(block), len(block) ^ 0xFFFF) + block
        for k, block in enumerate(blocks)
    )
    checksum = struct.pack(">I", zlib.adler32(rows))
    return b"\x78\x01" + b"\x00\x00\x00\xff\xff" * empty + body + checksum


def _flushed(rows: bytes, every: int) -> bytes:
    """Rows in blocks of a few bytes, each with its own code tables."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 15, 9)
    parts = [
        packer.compress(rows[k : k + every]) + packer.flush(zlib.Z_FULL_FLUSH)
        for k in range(0, len(rows), every)
    ]
    return b"".join([*parts, packer.flush()])


def _jpeg(grey: Grey, *options: int) -> bytes:
    return cv2.imencode(".jpg", grey, options)[1].tobytes()


def many_scans(grey: Grey, count: int) -> bytes:
    """A progressive JPEG with a scan that changes nothing, repeated."""
    packed = _jpeg(grey, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    last = packed.rindex(b"\xff\xda")
    head = packed[last : last + 10]  # marker, length, one component, its band and bits
    scan = head[:7] + bytes([1, 1, 0x00]) + b"\x00"
    return packed[:-2] + scan * count + packed[-2:]


def _before_the_scan(grey: Grey, more: bytes) -> bytes:
    packed = _jpeg(grey)
    scan = packed.index(b"\xff\xda")
    return packed[:scan] + more + packed[scan:]


def _tables(grey: Grey, count: int) -> bytes:
    packed = _jpeg(grey)
    start = packed.index(b"\xff\xc4")
    (length,) = struct.unpack(">H", packed[start + 2 : start + 4])
    return packed[start : start + 2 + length] * count


def _tiff(grey: Grey, rows_per_strip: int) -> bytes:
    packed = cv2.imencode(".tiff", grey, [cv2.IMWRITE_TIFF_ROWSPERSTRIP, rows_per_strip])[1]
    return packed.tobytes()


def hostile(grey: Grey, most: int) -> dict[str, Callable[[], bytes]]:
    """Makers of hostile pictures by their names; each has about ``most`` bytes, or fewer."""
    packed = zlib.compress(rows_of(grey), 1)
    text = chunk(b"zTXt", b"a\x00\x00" + zlib.compress(bytes(7_000_000)))
    return {
        "png, chunks of a byte": lambda: png(grey, packed, piece=1),
        "png, empty chunks": lambda: png(grey, packed, chunk(b"IDAT", b"") * (most // 12)),
        "png, short texts": lambda: png(grey, packed, chunk(b"tEXt", b"a\x00b") * (most // 15)),
        "png, unknown chunks": lambda: png(grey, packed, chunk(b"abCd", b"") * (most // 12)),
        "png, packed texts": lambda: png(grey, packed, *[text] * 40),
        "png, empty blocks": lambda: png(grey, _stored(rows_of(grey), most // 5)),
        "png, flushed blocks": lambda: png(grey, _flushed(rows_of(grey), 8)),
        "png, surplus": lambda: png(grey, zlib.compress(rows_of(grey) + bytes(60_000_000))),
        "jpeg, scans": lambda: many_scans(grey, most // 11),
        "jpeg, 60 scans": lambda: many_scans(grey, 50),
        "jpeg, comments": lambda: _before_the_scan(grey, b"\xff\xfe\x00\x02" * (most // 4)),
        "jpeg, tables": lambda: _before_the_scan(grey, _tables(grey, most // 33)),
        "jpeg, fill bytes": lambda: _before_the_scan(grey, b"\xff" * most),
        "jpeg, restarts": lambda: _jpeg(grey, cv2.IMWRITE_JPEG_RST_INTERVAL, 1),
        "tiff, strips of a row": lambda: _tiff(grey, 1),
        "tiff": lambda: _tiff(grey, 1 << 20),
        "webp": lambda: cv2.imencode(".webp", grey, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes(),
    }
