"""Packed pictures: what is damaged never reaches a decoder that could hang over it."""

import struct
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from tests.service.hostile_pictures import chunk

from rendezview.errors import RendezviewError
from rendezview.io.sequences.decoding import PNG, decode_grey
from rendezview.io.sequences.images import read_grey
from rendezview.io.sequences.message_images import PackedPicture, grey


@pytest.fixture(scope="module")
def image():
    return np.random.default_rng(8).integers(0, 256, (24, 32), dtype=np.uint8)


@pytest.fixture(scope="module")
def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


def animated(png: bytes) -> bytes:
    control = chunk(b"acTL", struct.pack(">II", 2, 0))
    return png[:33] + control + png[33:]


def damaged(png: bytes) -> bytes:
    content = bytearray(png)
    content[60] ^= 1
    return bytes(content)


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_a_picture_of_any_buffer_is_its_grey_levels(image, png, kind):
    np.testing.assert_array_equal(decode_grey(kind(png)), image)
    array = np.frombuffer(png, dtype=np.uint8)
    np.testing.assert_array_equal(decode_grey(array), image)


def test_other_files_than_png_are_decoded_too(image):
    for suffix in (".bmp", ".tiff"):
        np.testing.assert_array_equal(decode_grey(cv2.imencode(suffix, image)[1].tobytes()), image)


def test_what_follows_the_end_of_a_png_is_not_read(image, png):
    np.testing.assert_array_equal(decode_grey(png + b"more"), image)


@pytest.mark.parametrize("spoil", [animated, damaged, lambda png: png[:-1], lambda png: png[:8]])
def test_a_png_that_is_damaged_cut_short_or_animated_is_none_to_every_reader(png, tmp_path, spoil):
    content = spoil(png)
    assert decode_grey(content) is None
    path = tmp_path / "frame.png"
    path.write_bytes(content)
    with pytest.raises(RendezviewError, match=r"frame\.png: not an image"):
        read_grey(path)
    with pytest.raises(RendezviewError, match="bag: not a PNG"):
        grey(PackedPicture(content), "bag")


def test_every_single_wrong_bit_behind_the_signature_is_noticed(png):
    rng = np.random.default_rng(9)
    for place in rng.integers(len(PNG), len(png), 200):
        content = bytearray(png)
        content[place] ^= 1 << rng.integers(8)
        assert decode_grey(content) is None


@pytest.mark.parametrize("content", [b"", b"\x89PNG", b"no picture", bytes(1000)])
def test_no_picture_is_none(content):
    assert decode_grey(content) is None


def test_threads_decode_the_same_pictures_and_the_log_level_is_restored(png, image):
    level = cv2.utils.logging.getLogLevel()
    contents = [png, png[:-20], b"no picture"] * 100
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(decode_grey, contents))
    for content, picture in zip(contents, found, strict=True):
        assert (picture is None) == (content is not png)
        assert picture is None or picture.tobytes() == image.tobytes()
    assert cv2.utils.logging.getLogLevel() == level
