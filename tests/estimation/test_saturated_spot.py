"""The centre of a saturated spot from its rim."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from rendezview.estimation.saturated_spot import disc_light, fit_rim

NOTHING = np.zeros((0, 0), np.uint8)
AT = np.array([20.3, 19.6, 4.0, 0.05, -0.03, np.log(0.8), np.log(500.0)])


def plain_light(at, u, v):
    """(1) of the module in plain numpy."""
    x, y, radius, e1, e2, blur, peak = at
    angle = np.arctan2(v - y, u - x)
    rim = radius / np.sqrt(1.0 - 2.0 * (e1 * np.cos(2.0 * angle) + e2 * np.sin(2.0 * angle)))
    return np.exp(peak) * norm.cdf((rim - np.hypot(u - x, v - y)) / np.exp(blur))


def test_the_light_of_a_disc_and_its_derivatives_are_those_of_plain_numpy():
    slope, step = np.empty(7), 1e-5
    for u, v in ((16, 20), (23, 22), (25, 15), (20, 20)):
        assert disc_light(AT, u, v, slope) == pytest.approx(plain_light(AT, u, v), rel=1e-9)
        for k in range(7):
            ends = [plain_light(AT + step * s * np.eye(7)[k], u, v) for s in (-1.0, 1.0)]
            wanted = (ends[1] - ends[0]) / (2.0 * step)
            assert slope[k] == pytest.approx(wanted, rel=1e-5, abs=1e-4)


def disc(x, y, radius, peak, rng, size=61):
    """A blurred disc of 8 bits, sampled eight times a pixel, noise 2 grey, black level 10."""
    fine = (np.arange(8 * size) + 0.5) / 8.0 - 0.5
    far = np.hypot(fine[None, :] - x, fine[:, None] - y)
    inside = np.clip(0.5 + 8.0 * (radius - far), 0.0, 1.0)
    soft = gaussian_filter(inside, 0.7 * 8.0).reshape(size, 8, size, 8).mean(axis=(1, 3))
    noisy = 10.0 + peak * soft + rng.normal(0.0, 2.0, soft.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def bloomed(picture, rng):
    """Charge runs down the columns: over a quarter of each, and into a part of one pixel more."""
    out = picture.copy()
    for column in np.flatnonzero((picture == 255).any(axis=0)):
        full = np.flatnonzero(picture[:, column] == 255)
        end = full[-1] + 1 + round(0.25 * len(full))
        out[full[-1] + 1 : end, column] = 255
        out[end, column] = max(out[end, column], rng.integers(20, 250))
    return out


def fitted(picture, radius, noise=2.02):
    rows, columns = np.nonzero(picture > 30)
    box = (int(columns.min()), int(columns.max()), int(rows.min()), int(rows.max()))
    plane = (float(columns.mean()), float(rows.mean()), 10.0, 0.0, 0.0)
    return fit_rim(picture, NOTHING, plane, radius, noise, box)


@pytest.mark.parametrize("radius", [1.4, 2.7, 10.0])
@pytest.mark.parametrize("runs_over", [False, True])
def test_a_saturated_disc_is_where_it_is_claimed_to_be(radius, runs_over):
    rng, normalised, off = np.random.default_rng(3), [], []
    for _ in range(40):
        x, y = rng.uniform(29.5, 30.5, 2)
        picture = disc(x, y, radius, 500.0, rng)
        found = fitted(bloomed(picture, rng) if runs_over else picture, radius + 0.5)
        assert found[2] > 0.0
        off.append((found[0] - x, found[1] - y))
        normalised.append(np.square(off[-1]).sum() / (2.0 * found[2] ** 2))
    assert 0.5 < np.mean(normalised) < 1.6
    assert np.sqrt(np.mean(np.square(off))) < (0.06 if runs_over else 0.01)


def test_charge_that_runs_along_rows_is_left_out_too():
    rng = np.random.default_rng(5)
    for _ in range(10):
        picture = disc(30.2, 29.7, 4.0, 500.0, rng)
        found = fitted(bloomed(picture.T.copy(), rng).T.copy(), 4.5)
        assert np.abs(np.subtract(found[:2], (30.2, 29.7))).max() < 4.0 * found[2] < 0.4


def test_two_lights_that_run_together_have_no_rim_of_a_disc():
    rng = np.random.default_rng(6)
    pictures = disc(26.0, 30.0, 4.0, 500.0, rng), disc(34.0, 31.0, 3.0, 400.0, rng)
    assert fitted(np.maximum(*pictures), 5.0)[2] == 0.0
