"""Random pictures of the Earth from orbit."""

from __future__ import annotations

import numpy as np

from rendezview_ground.simulate.cloudy_skies import cloudy_sky


def test_skies_are_bright_varied_and_the_same_for_a_seed() -> None:
    skies = [cloudy_sky(96, np.random.default_rng([13, k])) for k in range(30)]
    np.testing.assert_array_equal(skies[0], cloudy_sky(96, np.random.default_rng([13, 0])))
    for sky in skies:
        assert sky.shape == (96, 96)
        assert sky.dtype == np.float32
        assert sky.min() >= 0.0
        assert 0.3 < sky.max() <= 1.3
    means = np.array([sky.mean() for sky in skies])
    assert np.ptp(means) > 0.4
    # Some have a limb with space beyond, some fill the picture
    dark = np.array([np.mean(sky < 0.02) for sky in skies])
    assert 2 <= np.count_nonzero(dark > 0.05) <= 25


def test_a_whole_earth_leaves_more_space_around_it() -> None:
    dark = []
    for whole in (False, True):
        skies = [cloudy_sky(96, np.random.default_rng([14, k]), whole=whole) for k in range(20)]
        assert all(0.3 < sky.max() <= 1.3 for sky in skies)
        dark.append(np.mean([np.mean(sky < 0.05) for sky in skies]))
    assert dark[1] > dark[0] + 0.1
