"""Frames that are small and would cost much: refused before a decoder sees them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.decoding import PNG, decode_grey
from rendezview_service.messages.frames import read_frame

CAMERA = Camera.from_fov(640, 480, 0.7)
GREY = np.random.default_rng(1).integers(0, 256, (480, 640), np.uint8)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )


def _png(rows: bytes, *more: bytes, depth: int = 8, interlaced: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", 640, 480, depth, 0, 0, 0, interlaced)
    packed = zlib.compress(rows, 1)
    chunks = [packed[k : k + 40_000] for k in range(0, len(packed), 40_000)]
    parts = [_chunk(b"IHDR", header), *more, *(_chunk(b"IDAT", part) for part in chunks)]
    return PNG + b"".join([*parts, _chunk(b"IEND", b"")])


def many_scans(count: int) -> bytes:
    """A valid progressive JPEG with a scan that changes nothing, repeated."""
    packed = cv2.imencode(".jpg", GREY, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = packed.rindex(b"\xff\xda")
    head = packed[last : last + 10]  # marker, length, one component, its band and bits
    scan = head[:7] + bytes([1, 1, 0x00]) + b"\x00"
    return packed[:-2] + scan * count + packed[-2:]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> Callable[[bytes], int]:
    """Refuses a frame that no decoder has seen; bytes of it that were unpacked."""
    unpacked: list[int] = []

    class Unpacking:
        def __init__(self) -> None:
            self._real = decompressobj()

        def decompress(self, packed: bytes, most: int) -> bytes:
            out = self._real.decompress(packed, most)
            unpacked.append(len(out))
            return out

        def __getattr__(self, name: str) -> object:
            return getattr(self._real, name)

    def refuse(content: bytes) -> int:
        unpacked.clear()
        with pytest.raises(RendezviewError, match="packed wastefully"):
            read_frame(content, CAMERA)
        return sum(unpacked)

    decompressobj = zlib.decompressobj
    monkeypatch.setattr(zlib, "decompressobj", Unpacking)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    return refuse


def test_a_jpeg_of_many_scans_is_refused_before_it_is_decoded(refused):
    refused(many_scans(150_000))


def test_a_jpeg_of_many_segments_is_refused_after_some_of_them(refused):
    packed = cv2.imencode(".jpg", GREY)[1].tobytes()

    class Counted(bytes):
        places = 0

        def __getitem__(self, place):
            Counted.places += 1
            return super().__getitem__(place)

    refused(Counted(packed[:2] + b"\xff\xfe\x00\x02" * 2_000_000 + packed[2:]))
    assert Counted.places < 5 * 1000  # of two million


@pytest.mark.parametrize("surplus", [100_000, 60_000_000])
def test_a_png_with_more_than_its_picture_is_refused(surplus, refused):
    rows = b"".join(b"\x00" + row.tobytes() for row in GREY)
    assert refused(_png(rows + bytes(surplus))) < len(rows) + 100_000


def test_packed_texts_of_a_png_never_reach_the_decoder(monkeypatch: pytest.MonkeyPatch):
    text = _chunk(b"zTXt", b"a\x00\x00" + zlib.compress(bytes(7_000_000)))
    rows = b"".join(b"\x00" + row.tobytes() for row in GREY)
    given: list[bytes] = []
    decode = cv2.imdecode

    def noted(data: np.ndarray, flags: int) -> np.ndarray:
        given.append(data.tobytes())
        return decode(data, flags)

    monkeypatch.setattr(cv2, "imdecode", noted)
    np.testing.assert_array_equal(read_frame(_png(rows, *[text] * 40), CAMERA), GREY)
    assert b"zTXt" not in given[0]


def test_common_files_are_read_as_before():
    rows = b"".join(b"\x00" + row.tobytes() for row in GREY)
    np.testing.assert_array_equal(read_frame(_png(rows), CAMERA), GREY)
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 95]
    for suffix, options in ((".jpg", progressive), (".jpg", []), (".png", [])):
        for image in (GREY, cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR), GREY.astype(np.uint16) * 257):
            if suffix == ".jpg" and image.dtype == np.uint16:
                continue
            packed = cv2.imencode(suffix, image, options)[1].tobytes()
            assert np.abs(read_frame(packed, CAMERA).astype(float) - GREY).mean() < 6.0
    tiny = cv2.imencode(".png", np.eye(3, dtype=np.uint8) * 255)[1].tobytes()
    np.testing.assert_array_equal(decode_grey(tiny), np.eye(3) * 255)
