"""Random craft before random skies."""

import numpy as np

from rendezview_ground.simulate.foreground_frames import HEIGHT, WIDTH, foreground_frame
from rendezview_ground.simulate.random_skies import random_sky


def test_a_picture_shows_the_craft_that_its_cover_says():
    brighter = 0
    for seed in range(10):
        picture, cover = foreground_frame(np.random.default_rng(seed))
        assert picture.shape == cover.shape == (HEIGHT, WIDTH)
        share = np.mean(cover > 127)
        assert 0.0005 < share < 0.6
        edge = np.abs(np.diff(picture.astype(float), axis=1))
        border = np.abs(np.diff(cover.astype(float), axis=1)) > 127
        brighter += edge[border].mean() > 2.0 * edge[~border].mean()
    assert brighter >= 7


def test_the_same_seed_gives_the_same_picture():
    first, second = (foreground_frame(np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_skies_are_bright_and_of_any_size():
    for seed in range(12):
        sky = random_sky(50, 90, np.random.default_rng(seed))
        assert sky.shape == (50, 90)
        assert sky.min() >= -0.05
        assert 0.0 < sky.max() <= 1.3
