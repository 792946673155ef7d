"""Moments under a Gaussian window against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.estimation.spot_centroid import window_moments


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
        wanted = [s.sum() for s in (*sums, w**2, 0.5 * w**2 * (dx**2 + dy**2))]
        scale = [np.abs(s).sum() for s in (*sums, w**2, w**2 * (dx**2 + dy**2))]
        np.testing.assert_allclose(np.divide(found, scale), np.divide(wanted, scale), atol=1e-12)


def test_a_window_outside_the_picture_has_no_moments():
    image = np.zeros((8, 8), np.uint8)
    found = window_moments(
        image, image[:0, :0], 0.0, 20.0, 4.0, 1.0, (17, 7, 1, 7), np.empty(8), np.empty(8)
    )
    assert found == (0.0,) * 7
