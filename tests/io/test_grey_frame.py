"""A grey frame: refused in words when it is none, and its noise."""

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.io.grey_frame import check_frame, grain


def test_a_frame_that_fits_is_taken_as_it_is():
    frame = np.random.default_rng(1).integers(0, 256, (120, 160)).astype(np.uint8)
    assert np.array_equal(check_frame(frame, 160, 120), frame)
    assert np.array_equal(check_frame(frame[:, ::-1], 160, 120), frame[:, ::-1])
    assert check_frame(frame[:, ::-1], 160, 120).flags.c_contiguous


WRONG = {
    "NaN": np.full((120, 160), np.nan),
    "uint8": np.zeros((120, 160)),
    "uint16": np.zeros((120, 160), np.uint16),
    "colour": np.zeros((120, 160, 3), np.uint8),
    "4 colour": np.zeros((120, 160, 4), np.uint8),
    "160 × 120": np.zeros((60, 80), np.uint8),
    "height, width": np.zeros((120, 160, 7), np.uint8),
    "grey levels": np.zeros(0, np.uint8),
    "bool": np.zeros((120, 160), bool),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_frame_that_does_not_fit_is_refused_in_words(words):
    with pytest.raises(RendezviewError, match=words):
        check_frame(WRONG[words], 160, 120)


@pytest.mark.parametrize("sigma", [1.0, 3.0, 6.0])
def test_grain_is_the_noise_of_neighbouring_pixels_whatever_lies_behind(sigma):
    rng = np.random.default_rng(0)
    ramp = np.linspace(20.0, 180.0, 300)[None, :] * np.ones((200, 1))
    frame = np.clip(np.rint(ramp + rng.normal(0.0, sigma, ramp.shape)), 0, 255).astype(np.uint8)
    assert grain(frame, 64) == pytest.approx(sigma, rel=0.15)
