"""Grey levels of a known radiance, and their noise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rendezview_ground.simulate.sensor import (
    SensorOptions,
    automatic_exposure,
    expose,
    with_aureole,
)

PERFECT = SensorOptions(blur_sigma_px=0.0, noise_sigma_grey=0.0, black_level_grey=0.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_a_perfect_sensor_is_linear_rounds_and_saturates() -> None:
    radiance = np.array([[0.0, 0.1, 0.5012, 1.275, 9.0]], np.float32)
    grey = expose(radiance, 200.0, PERFECT, rng())
    assert grey.dtype == np.uint8
    np.testing.assert_array_equal(grey, [[0, 20, 100, 255, 255]])


@pytest.mark.parametrize("sigma_px", [0.7, 1.5])
def test_a_points_picture_has_the_asked_width_and_its_place(sigma_px: float) -> None:
    radiance = np.zeros((41, 41), np.float32)
    radiance[20, 23] = 1.0
    options = SensorOptions(blur_sigma_px=sigma_px, noise_sigma_grey=0.0, black_level_grey=0.0)
    grey = expose(radiance, 250.0 * 2 * math.pi * sigma_px**2, options, rng()).astype(float)
    columns = np.arange(41)
    profile = grey.sum(axis=0) / grey.sum()
    assert profile @ columns == pytest.approx(23.0, abs=1e-9)
    # A Gaussian sampled at pixel centres and rounded to grey levels
    assert math.sqrt(profile @ (columns - 23.0) ** 2) == pytest.approx(sigma_px, rel=0.05)


def test_blur_does_not_darken_the_edge_of_the_frame() -> None:
    grey = expose(np.full((9, 9), 0.5, np.float32), 200.0, SensorOptions(noise_sigma_grey=0), rng())
    assert (grey == 105).all()


def test_overexposure_multiplies_the_signal_until_it_saturates() -> None:
    options = replace(PERFECT, overexposure=5.0)
    grey = expose(np.array([[0.01, 0.1, 0.3]], np.float32), 200.0, options, rng())
    np.testing.assert_array_equal(grey, [[10, 100, 255]])


def test_the_aureole_keeps_the_light_and_falls_with_the_square_of_the_distance() -> None:
    radiance = np.zeros((513, 513), np.float32)
    radiance[256, 256] = 1e6
    spread = with_aureole(radiance, 0.1)
    assert spread.sum() == pytest.approx(1e6, rel=0.02)
    assert spread[256, 256] == pytest.approx(0.9e6, rel=0.02)
    y, x = np.mgrid[:513, :513] - 256
    distance = np.hypot(x, y)
    near, far = (spread[np.abs(distance - r) < 1.5].mean() for r in (10.0, 40.0))
    assert near / far == pytest.approx(16.0, rel=0.3)
    np.testing.assert_allclose(spread, spread[::-1, ::-1], atol=0.05 * spread[256, 266])


def test_bloom_lights_the_sky_beside_a_burnt_out_face() -> None:
    radiance = np.zeros((60, 80), np.float32)
    radiance[:, :40] = 10.0
    plain, bloomed = (
        expose(radiance, 200.0, replace(PERFECT, bloom=bloom), rng()) for bloom in (0.0, 0.05)
    )
    assert not plain[:, 45:].any()
    assert (bloomed[:, :38] == 255).all()
    assert bloomed[30, 42] > bloomed[30, 50] > bloomed[30, 70] > 0


def test_read_noise_has_the_asked_sigma() -> None:
    options = SensorOptions(blur_sigma_px=0.0, noise_sigma_grey=3.0)
    grey = expose(np.full((200, 200), 0.5, np.float32), 200.0, options, rng()).astype(float)
    assert grey.mean() == pytest.approx(105.0, abs=0.1)
    assert grey.std() == pytest.approx(math.hypot(3.0, 1 / math.sqrt(12)), rel=0.02)


def test_photon_noise_grows_with_the_square_root_of_the_signal() -> None:
    options = SensorOptions(
        blur_sigma_px=0.0, noise_sigma_grey=0.0, black_level_grey=0.0, electrons_per_grey=2.0
    )
    for level in (50.0, 150.0):
        grey = expose(np.full((200, 200), level, np.float32), 1.0, options, rng()).astype(float)
        assert grey.mean() == pytest.approx(level, rel=0.01)
        # σ² = electrons / electrons_per_grey² = level / electrons_per_grey, and rounding's 1/12
        assert grey.var() == pytest.approx(level / 2.0 + 1 / 12, rel=0.05)


def test_the_same_seed_gives_the_same_noise_and_another_another() -> None:
    radiance = np.full((20, 20), 0.3, np.float32)
    first, again = (expose(radiance, 200.0, SensorOptions(), rng()) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = expose(radiance, 200.0, SensorOptions(), np.random.default_rng(8))
    assert (first != other).mean() > 0.5


def test_automatic_exposure_puts_the_median_of_the_brightest_tenth_at_200() -> None:
    radiance = np.linspace(0.1, 0.9, 10_000, dtype=np.float32).reshape(100, 100)
    exposure = automatic_exposure([(radiance, np.ones((100, 100), np.float32))], 5.0)
    assert exposure is not None
    grey = np.sort((radiance * exposure + 5.0).ravel())
    assert np.median(grey[-1000:]) == pytest.approx(200.0, abs=1.5)


def test_automatic_exposure_ignores_dark_sides_and_edges() -> None:
    radiance = np.full((50, 50), 0.01, np.float32)  # a target mostly in the dark
    coverage = np.ones((50, 50), np.float32)
    radiance[:5, :] = 0.5
    radiance[5, :], coverage[5, :] = 40.0, 0.5  # glints on the outline do not count
    exposure = automatic_exposure([(radiance, coverage)])
    assert exposure == pytest.approx(200.0 / 0.5, rel=1e-5)


def test_automatic_exposure_of_the_dark_is_none() -> None:
    dark, covered = np.zeros((4, 4), np.float32), np.ones((4, 4), np.float32)
    assert automatic_exposure([(dark, covered)]) is None
    assert automatic_exposure([]) is None
