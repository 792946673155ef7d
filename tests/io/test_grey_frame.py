"""A grey frame: refused in words when it is none, and its noise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.grey_frame import check_frame, grain
from rendezview.io.sequences.decoding import decode_grey

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)


def test_a_frame_that_fits_is_taken_as_it_is():
    frame = np.random.default_rng(1).integers(0, 256, (120, 160)).astype(np.uint8)
    assert np.array_equal(check_frame(frame, CAMERA), frame)
    assert np.array_equal(check_frame(frame[:, :, None], CAMERA), frame)
    assert np.array_equal(check_frame(frame[:, ::-1], CAMERA), frame[:, ::-1])
    assert check_frame(frame[:, ::-1], CAMERA).flags.c_contiguous


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_an_array_is_taken_as_its_file_is(channels, kind):
    top = 255 if kind is np.uint8 else 4095
    pixels = np.random.default_rng(2).integers(0, top + 1, (120, 160, channels)).astype(kind)
    if channels == 4:
        pixels[:, :, 3] = np.iinfo(kind).max
    camera = replace(CAMERA, bit_depth=12)
    found = check_frame(pixels, camera)
    stored = decode_grey(cv2.imencode(".png", pixels)[1].tobytes(), 12)
    assert found.dtype == np.uint8
    assert np.abs(found.astype(int) - stored).max() <= 1  # libpng rounds otherwise
    assert np.array_equal(check_frame(pixels[::2, ::2], camera.binned(2)), found[::2, ::2])


def test_levels_beyond_the_depth_are_refused():
    with pytest.raises(RendezviewError, match="a level of 1024 needs more than 10 bits"):
        check_frame(np.full((120, 160), 1024, np.uint16), replace(CAMERA, bit_depth=10))


WRONG = {
    "NaN": np.full((120, 160), np.nan),
    "uint8": np.zeros((120, 160)),
    "uint16: give the camera a bit_depth": np.zeros((120, 160), np.uint16),
    "not None": None,
    "a bit_depth": np.zeros((120, 160, 3), np.uint16),
    r"\(2, 120, 160\)": np.zeros((2, 120, 160), np.uint8),
    "160 × 120": np.zeros((60, 80), np.uint8),
    "height, width": np.zeros((120, 160, 7), np.uint8),
    "grey levels": np.zeros(0, np.uint8),
    "bool": np.zeros((120, 160), bool),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_frame_that_does_not_fit_is_refused_in_words(words):
    with pytest.raises(RendezviewError, match=words):
        check_frame(WRONG[words], CAMERA)


@pytest.mark.parametrize("sigma", [1.0, 3.0, 6.0])
def test_grain_is_the_noise_of_neighbouring_pixels_whatever_lies_behind(sigma):
    rng = np.random.default_rng(0)
    ramp = np.linspace(20.0, 180.0, 300)[None, :] * np.ones((200, 1))
    frame = np.clip(np.rint(ramp + rng.normal(0.0, sigma, ramp.shape)), 0, 255).astype(np.uint8)
    assert grain(frame, 64) == pytest.approx(sigma, rel=0.15)
