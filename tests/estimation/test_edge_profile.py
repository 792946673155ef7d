"""Blurred steps on profiles: the compiled fits against plain numpy, and against the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from rendezview.estimation.edge_profile import (
    REACH,
    TAPS,
    WINDOWS,
    allowed_square,
    fit_adjacent,
    fit_step,
    narrow_step,
    residual_square,
    step_basis,
    step_filters,
)

BLUR = 0.9
D = np.arange(-REACH, REACH + 1.0)


def profile_of(level, contrast, place):
    return level + contrast * ndtr((D - place) / BLUR)


def test_a_step_is_fitted_as_by_numpys_least_squares():
    rng = np.random.default_rng(0)
    filters, basis = step_filters(BLUR), step_basis(BLUR)
    for _ in range(50):
        profile = rng.uniform(0.0, 255.0, TAPS)
        for window, (first, last) in zip(filters, WINDOWS, strict=True):
            taps = slice(first + REACH, last + REACH + 1)
            wanted = np.linalg.lstsq(basis[:, taps].T, profile[taps], rcond=None)[0]
            np.testing.assert_allclose(fit_step(profile, window), wanted, rtol=1e-9, atol=1e-9)


def test_the_place_of_a_step_is_found():
    for place in (-0.2, 0.0, 0.1, 0.3):
        _, contrast, shifted = fit_step(profile_of(40.0, 100.0, place), step_filters(BLUR)[0])
        assert contrast == pytest.approx(100.0, rel=0.1)
        assert shifted / contrast == pytest.approx(place, abs=0.01)


def test_crowded_steps_are_fitted_as_by_numpys_normal_equations():
    rng = np.random.default_rng(1)
    basis = step_basis(BLUR)
    for _ in range(50):
        inner, outer = -rng.uniform(2.2, 6.0), rng.uniform(2.2, 6.0)
        profile, solved = rng.uniform(0.0, 255.0, TAPS), np.zeros(5)
        variance = fit_adjacent(profile, inner, outer, BLUR, solved)
        rows = np.column_stack([*basis, ndtr((D - outer) / BLUR), ndtr((D - inner) / BLUR) - 1.0])
        normal = rows.T @ rows + np.diag([1e-4, 1e-4, 1e-4, 1e-2, 1e-2])
        wanted = np.linalg.solve(normal, rows.T @ profile)
        wanted[0] -= wanted[4]
        # The compiled loop reads Φ from a table that is right to 1e-6.
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(solved / scale, wanted / scale, atol=1e-3)
        assert variance == pytest.approx(np.linalg.inv(normal)[2, 2], rel=1e-3)


def test_residuals_are_those_of_plain_numpy():
    rng = np.random.default_rng(2)
    basis = step_basis(BLUR)
    for _ in range(20):
        profile, solved = rng.uniform(0.0, 255.0, TAPS), rng.normal(0.0, 20.0, 5)
        model = np.array([30.0, 80.0, 12.0]) @ basis
        found = residual_square(profile, basis, 30.0, 80.0, 12.0, -3.0, 4.0, BLUR, solved, False)
        assert found == pytest.approx(np.sum((profile - model) ** 2), rel=1e-12)
        model += solved[3] * ndtr((D - 4.0) / BLUR) + solved[4] * ndtr((D + 3.0) / BLUR)
        found = residual_square(profile, basis, 30.0, 80.0, 12.0, -3.0, 4.0, BLUR, solved, True)
        assert found == pytest.approx(np.sum((profile - model) ** 2), rel=1e-4)
    assert allowed_square(4, 2.0, -50.0, 0.5) == pytest.approx(1.5 * 4 * 4.1 + (50 * 0.07) ** 2)


def test_a_narrow_window_leaves_an_unknown_edge_out():
    filters, basis = step_filters(BLUR), step_basis(BLUR)
    profile = profile_of(40.0, 100.0, 0.2) - 60.0 * ndtr((D - 3.2) / BLUR)
    contrast, place, rest, variance = narrow_step(profile, filters, basis, 2.0, 100.0, 1.6)
    assert variance > 0.0
    assert rest < 50.0
    assert contrast == pytest.approx(100.0, rel=0.15)
    assert place == pytest.approx(0.2, abs=0.2)
    assert narrow_step(profile, filters, basis, 2.0, -100.0, 1.6)[3] < 0.0
