"""Frames that are small and would cost much: refused before a decoder sees them, or cheap."""

from __future__ import annotations

import contextlib
import time
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from tests.service.hostile_pictures import chunk, hostile, many_scans, png, rows_of

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.decoding import decode_grey
from rendezview_service.messages.frames import longest_frame, read_frame
from rendezview_service.worker.worker import decoding_s

CAMERA = Camera.from_fov(640, 480, 0.7)
GREY = np.random.default_rng(1).integers(0, 256, (480, 640), np.uint8)
HOSTILE = hostile(GREY, 30_000_000)


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


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_picture_takes_less_than_what_ends_its_process(name):
    content = HOSTILE[name]()
    start_s = time.process_time()
    with contextlib.suppress(RendezviewError):
        read_frame(content, CAMERA)
    spent_s = time.process_time() - start_s
    assert spent_s < 0.7 * decoding_s(CAMERA), (spent_s, len(content))


def test_a_jpeg_of_many_scans_is_refused_before_it_is_decoded(refused):
    refused(many_scans(GREY, 150_000))


def test_a_jpeg_of_many_segments_is_refused_after_some_of_them(refused):
    packed = cv2.imencode(".jpg", GREY)[1].tobytes()

    class Counted(bytes):
        places = 0

        def __getitem__(self, place):
            Counted.places += 1
            return super().__getitem__(place)

    refused(Counted(packed[:2] + b"\xff\xfe\x00\x02" * 900_000 + packed[2:]))
    assert Counted.places < 5 * 1000  # of 900 thousand


def test_a_png_of_many_chunks_is_refused_after_some_of_them(refused):
    packed = zlib.compress(rows_of(GREY), 9)
    many = png(GREY, packed, piece=1)
    assert len(many) < longest_frame(640, 480)
    assert refused(many) < 10_000


@pytest.mark.parametrize("surplus", [100_000, 60_000_000])
def test_a_png_with_more_than_its_picture_is_refused(surplus, refused):
    rows = rows_of(GREY)
    assert refused(png(GREY, zlib.compress(rows + bytes(surplus), 1))) < len(rows) + 100_000


def test_packed_texts_of_a_png_never_reach_the_decoder(monkeypatch: pytest.MonkeyPatch):
    text = chunk(b"zTXt", b"a\x00\x00" + zlib.compress(bytes(7_000_000)))
    given: list[bytes] = []
    decode = cv2.imdecode

    def noted(data: np.ndarray, flags: int) -> np.ndarray:
        given.append(data.tobytes())
        return decode(data, flags)

    monkeypatch.setattr(cv2, "imdecode", noted)
    content = png(GREY, zlib.compress(rows_of(GREY), 1), *[text] * 40)
    np.testing.assert_array_equal(read_frame(content, CAMERA), GREY)
    assert b"zTXt" not in given[0]


def test_a_file_longer_than_any_of_its_camera_is_refused(refused):
    packed = zlib.compress(rows_of(GREY), 1)
    texts = chunk(b"tEXt", b"a\x00" + b"b" * 100_000)
    assert refused(png(GREY, packed, *[texts] * 40)) == 0


def test_common_files_are_read_as_before():
    np.testing.assert_array_equal(read_frame(png(GREY, zlib.compress(rows_of(GREY))), CAMERA), GREY)
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 95]
    for suffix, options in ((".jpg", progressive), (".jpg", []), (".png", [])):
        for image in (GREY, cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR), GREY.astype(np.uint16) * 257):
            if suffix == ".jpg" and image.dtype == np.uint16:
                continue
            packed = cv2.imencode(suffix, image, options)[1].tobytes()
            assert np.abs(read_frame(packed, CAMERA).astype(float) - GREY).mean() < 6.0
    tiny = cv2.imencode(".png", np.eye(3, dtype=np.uint8) * 255)[1].tobytes()
    np.testing.assert_array_equal(decode_grey(tiny), np.eye(3) * 255)


def test_the_longest_common_file_is_shorter_than_the_limit():
    """Of noise, four levels of 16 bits a pixel: nothing is packed."""
    noise = np.random.default_rng(2).integers(0, 1 << 16, (480, 640, 4), np.uint16)
    packed = cv2.imencode(".png", noise)[1].tobytes()
    assert len(packed) < longest_frame(640, 480) - 900_000
    assert read_frame(packed, CAMERA).shape == (480, 640)
