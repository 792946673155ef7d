"""The centroid of a spot, and its loops against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.special import erf

from rendezview.estimation.spot_centroid import (
    centre_spot,
    elongation,
    overlap_error,
    pixel_moments,
    ring_plane,
    window_moments,
)

NOTHING = np.zeros((0, 0), np.uint8)


@pytest.mark.parametrize("with_dark", [False, True])
def test_window_moments_are_those_of_plain_numpy(with_dark):
    rng = np.random.default_rng(0)
    for _ in range(20):
        image = rng.integers(0, 256, (30, 40)).astype(np.uint8)
        dark = rng.integers(0, 60, image.shape).astype(np.uint8) if with_dark else image[:0, :0]
        x, y, sigma = rng.uniform(5, 35), rng.uniform(5, 25), rng.uniform(0.6, 6.0)
        x0, x1, y0, y1 = 3, int(rng.integers(20, 40)), 0, int(rng.integers(15, 30))
        found = window_moments(
            image, dark, 7.5, x, y, sigma, (x0, x1, y0, y1), np.empty(40), np.empty(30)
        )
        rows, columns = np.mgrid[y0 : y1 + 1, x0 : x1 + 1]
        dx, dy = columns - x, rows - y
        value = image[y0 : y1 + 1, x0 : x1 + 1] - 7.5
        if with_dark:
            value = value - dark[y0 : y1 + 1, x0 : x1 + 1]
        w = np.exp(-0.5 * (dx**2 + dy**2) / sigma**2)
        sums = [w * value * f for f in (1, dx, dy, dx**2, dy**2)]
        wanted = [s.sum() for s in (*sums, 0.5 * w**2 * (dx**2 + dy**2))]
        scale = [np.abs(s).sum() for s in (*sums, w**2 * (dx**2 + dy**2))]
        np.testing.assert_allclose(np.divide(found, scale), np.divide(wanted, scale), atol=1e-12)


def test_a_window_outside_the_picture_has_no_moments():
    image = np.zeros((8, 8), np.uint8)
    found = window_moments(
        image, image[:0, :0], 0.0, 20.0, 4.0, 1.0, (17, 7, 1, 7), np.empty(8), np.empty(8)
    )
    assert found == (0.0,) * 6


def spot(x, y, sigma, peak, size=41):
    """A Gaussian light, integrated over the pixels, and its peak before that."""
    edges = np.arange(size + 1) - 0.5
    gx, gy = (0.5 * np.diff(erf((edges - c) / (sigma * np.sqrt(2.0)))) for c in (x, y))
    light = gy[:, None] * gx
    return peak * light / light.max()


def read(picture, x, y, sigma, noise):
    columns, rows = np.empty(64), np.empty(64)
    half = int(2.5 * sigma) + 1
    box = (int(x) - half, int(x) + half, int(y) - half, int(y) + half)
    level, slope_x, slope_y, rough, doubt = ring_plane(picture, NOTHING, box, noise)
    plane, start = (level, slope_x, slope_y, doubt), (float(int(x)), float(int(y)), sigma)
    return centre_spot(picture, NOTHING, plane, start, rough, columns, rows)


def test_moments_of_a_spot_on_pixels_are_those_of_its_picture():
    u = np.arange(3, 20)
    for x, spread, window in ((10.3, 0.25, 1.2), (9.75, 1.5, 1.2), (11.0, 0.04, 2.0)):
        pixels = np.diff(erf((np.arange(3, 21) - 0.5 - x) / np.sqrt(2.0 * spread)))
        weight = pixels * np.exp(-0.5 * (u - x) ** 2 / window**2)
        wanted = [(weight * (u - x) ** k).sum() / weight.sum() for k in (1, 2)]
        np.testing.assert_allclose(pixel_moments(x, spread, window, 3, 19), wanted, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.5, 0.6, 0.85, 1.5])
def test_a_spots_place_does_not_depend_on_its_place_within_the_pixel(sigma):
    rng = np.random.default_rng(0)
    for phase in np.linspace(0.0, 0.9, 7):
        places, sizes = [], []
        for _ in range(6):  # rounding, averaged
            light = (
                10.0 + spot(20.0 + phase, 20.35, sigma, 220.0) + rng.uniform(-0.5, 0.5, (41, 41))
            )
            found = read(np.rint(light).astype(np.uint8), 20.0 + phase, 20.35, sigma, 0.3)
            places.append(found[:2])
            sizes.append(found[2])
        off = np.mean(places, axis=0) - (20.0 + phase, 20.35)
        assert np.abs(off).max() < 0.006
        assert np.mean(sizes) == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.02)


@pytest.mark.parametrize(("sigma", "peak"), [(0.6, 40.0), (0.85, 14.0), (0.85, 180.0), (2.0, 60.0)])
def test_the_claimed_error_is_the_error_and_near_the_bound(sigma, peak):
    rng, off, claimed = np.random.default_rng(1), [], []
    for _ in range(200):
        x, y = rng.uniform(19.5, 20.5, 2)
        light = 20.0 + spot(x, y, sigma, peak) + rng.normal(0.0, 2.0, (41, 41))
        found = read(np.clip(np.rint(light), 0, 255).astype(np.uint8), x, y, sigma, 2.02)
        off.append((found[0] - x, found[1] - y))
        claimed.append(found[4])
    rms = np.sqrt(np.mean(np.square(off)))
    assert 0.8 < np.sqrt(np.mean(np.square(off) / np.square(claimed)[:, None])) < 1.3
    assert rms < 1.35 * np.sqrt(2.0 / np.pi) * 2.02 / peak


def test_a_wide_spot_on_a_flat_ground_is_not_moved_by_a_slope_of_chance():
    """A disc of 10 px radius: its claimed error holds, and is near that of a known ground."""
    rng, off, claimed = np.random.default_rng(4), [], []
    rows, columns = np.mgrid[:101, :101]
    for _ in range(80):
        x, y = rng.uniform(49.5, 50.5, 2)
        disc = 176.0 * np.clip(10.5 - np.hypot(columns - x, rows - y), 0.0, 1.0)
        light = np.clip(np.rint(10.0 + disc + rng.normal(0.0, 2.83, disc.shape)), 0, 255)
        picture = light.astype(np.uint8)
        plane = ring_plane(picture, NOTHING, (40, 60, 40, 60), 2.85)
        found = centre_spot(
            picture, NOTHING, (*plane[:3], plane[4]), (50.0, 50.0, 6.0), plane[3], np.empty(101),
            np.empty(101),
        )  # fmt: skip
        off.append((found[0] - x, found[1] - y))
        claimed.append(found[4])
    assert np.sqrt(np.mean(np.square(off))) < 1.25 * 0.8 * 2.83 / 176.0
    assert 0.8 < np.sqrt(np.mean(np.square(off) / np.square(claimed)[:, None])) < 1.25


def test_the_background_is_the_plane_of_the_ring_without_its_neighbours():
    rows, columns = np.mgrid[:41, :41]
    rng = np.random.default_rng(2)
    plane = 60.0 + 0.8 * (columns - 20) - 0.5 * (rows - 20)
    light = plane + spot(20.0, 20.0, 1.0, 100.0) + spot(28.0, 14.0, 1.0, 100.0)
    noisy = np.clip(np.rint(light + rng.normal(0.0, 1.0, light.shape)), 0, 255).astype(np.uint8)
    level, slope_x, slope_y, rough, doubt = ring_plane(noisy, NOTHING, (17, 23, 17, 23), 1.04)
    assert level == pytest.approx(60.0, abs=0.5)
    assert (slope_x, slope_y) == pytest.approx((0.8, -0.5), abs=0.06)
    assert 1.0 <= rough < 2.5
    assert 0.0 < doubt < 0.06
    found = read(noisy, 20.0, 20.0, 1.0, 1.04)
    assert np.hypot(found[0] - 20.0, found[1] - 20.0) < 0.06


def test_a_textured_ring_makes_the_error_larger():
    rng = np.random.default_rng(3)
    waves = np.hypot(*np.meshgrid(np.fft.fftfreq(41), np.fft.fftfreq(41)))
    soft = np.fft.ifft2(
        np.fft.fft2(rng.standard_normal((41, 41))) * np.exp(-2.0 * (np.pi * waves * 1.5) ** 2)
    ).real
    textured = np.clip(np.rint(60.0 + 8.0 * soft / soft.std()), 0, 255).astype(np.uint8)
    assert ring_plane(textured, NOTHING, (17, 23, 17, 23), 1.0)[3] > 10.0


def test_an_overlap_is_half_the_moment_of_what_differs_from_the_opposite_side():
    """In plain numpy; a spot by itself has none."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[:41, :41].astype(float)
    x, y, size, peak, slopes, noise = 20.3, 19.6, 3.0, 150.0, (0.4, -0.2), 1.5
    alone = 30.0 + slopes[0] * (columns - x) + slopes[1] * (rows - y) + spot(x, y, size, peak)
    alone = alone + rng.normal(0.0, 1.0, alone.shape)
    beside = alone + spot(25.0, 22.0, 1.5, 90.0)
    for light, overlapped in ((alone, False), (beside, True)):
        picture = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        told = overlap_error(picture, NOTHING, (x, y, size, peak), slopes, noise)
        opposite = map_coordinates(picture.astype(float), [2 * y - rows, 2 * x - columns], order=1)
        dx, dy = columns - x, rows - y
        off = np.abs(picture - opposite - 2.0 * (slopes[0] * dx + slopes[1] * dy))
        limit = max(5.0 * np.sqrt(2.0) * noise, max(0.1, 0.5 / size**2) * peak)
        window = (rows <= y) & (np.abs(dx) <= 3.0 * size) & (np.abs(dy) <= 3.0 * size)
        far2 = dx**2 + dy**2
        moment = np.sum(
            (np.exp(-0.5 * far2 / size**2) * off * np.sqrt(far2))[window & (off > limit)]
        )
        assert told == pytest.approx(1.5 * moment / (np.pi * size**2 * peak), rel=1e-9)
        assert (told > 0.1) == overlapped


@pytest.mark.parametrize("size", [1.2, 2.5])
def test_a_window_of_its_size_shows_half_of_a_spots_elongation(size):
    rows, columns = np.mgrid[:40, :50]
    x, y, turn, stretch = 24.3, 19.6, 0.7, 0.1  # of the variances along and across
    along = (columns - x) * np.cos(turn) + (rows - y) * np.sin(turn)
    across = (rows - y) * np.cos(turn) - (columns - x) * np.sin(turn)
    square = along**2 / (1.0 + stretch) + across**2 / (1.0 - stretch)
    spot = 20.0 + 0.3 * columns + 180.0 * np.exp(-0.5 * square / size**2)
    picture = np.clip(np.rint(spot), 0, 255).astype(np.uint8)
    found = elongation(picture, NOTHING, (x, y, size), (20.0, 0.3, 0.0))
    wanted = 0.5 * stretch * np.array([np.cos(2.0 * turn), np.sin(2.0 * turn)])
    np.testing.assert_allclose(found, wanted, atol=0.006)
