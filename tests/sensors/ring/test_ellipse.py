"""Ellipse fits against true ellipses and against each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.sensors.ring.paper_ellipse import fit_paper

from rendezview.sensors.ring import Ellipse

THIRD = 2.0 * math.pi / 3.0


def points_of(a, b, angle, arc, count, sigma, rng):
    t = 1.0 + np.linspace(0.0, arc, count, endpoint=False)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = np.column_stack([a * np.cos(t), b * np.sin(t)]) @ turn.T + [300.0, 200.0]
    return points + rng.normal(0.0, sigma, points.shape)


@pytest.mark.parametrize("fit", [fit_paper, Ellipse.fit])
@pytest.mark.parametrize("angle", [-1.2, -0.3, 0.4, 1.5])
def test_every_fit_is_exact_without_noise_and_keeps_the_sign_of_the_angle(fit, angle):
    rng = np.random.default_rng(0)
    ellipse = fit(points_of(120.0, 60.0, angle, 2.0 * math.pi, 60, 1e-7, rng))
    np.testing.assert_allclose(ellipse.centre_px, [300.0, 200.0], atol=1e-5)
    np.testing.assert_allclose(ellipse.semi_axes_px, [120.0, 60.0], atol=1e-5)
    assert ellipse.angle_rad == pytest.approx(angle, abs=1e-6)


def test_on_a_third_of_the_arc_the_papers_fit_is_biased_and_the_geometric_is_not():
    rng = np.random.default_rng(1)
    errors = {fit_paper: [], Ellipse.fit: []}
    for _ in range(150):
        points = points_of(120.0, 60.0, 0.4, THIRD, 200, 0.3, rng)
        for fit, found in errors.items():
            found.append(fit(points).semi_axes_px[0] - 120.0)
    assert np.median(errors[fit_paper]) < -4.0
    assert abs(np.median(errors[Ellipse.fit])) < 0.4


@pytest.mark.parametrize("arc", [2.0 * math.pi, THIRD])
def test_the_covariance_is_that_of_the_errors(arc):
    rng = np.random.default_rng(2)
    odd = []
    for _ in range(200):
        ellipse = Ellipse.fit(points_of(120.0, 60.0, 0.4, arc, 200, 0.3, rng))
        error = np.array([*(ellipse.centre_px - [300, 200]), ellipse.semi_axes_px[0] - 120,
                          ellipse.semi_axes_px[1] - 60, ellipse.angle_rad - 0.4])  # fmt: skip
        odd.append(error @ np.linalg.solve(ellipse.covariance, error) / 5.0)
    assert 0.8 < np.mean(odd) < 1.25


def test_a_circle_has_a_finite_covariance_although_its_angle_means_nothing():
    rng = np.random.default_rng(3)
    ellipse = Ellipse.fit(points_of(80.0, 80.0, 0.0, 2.0 * math.pi, 100, 0.05, rng))
    assert np.isfinite(ellipse.covariance).all()
    assert ellipse.covariance[4, 4] <= math.pi**2 / 12.0 + 1e-9
    assert np.linalg.eigvalsh(ellipse.covariance).min() > -1e-12


def test_residuals_are_distances():
    ellipse = Ellipse(np.array([10.0, 20.0]), (50.0, 50.0), 0.0)
    np.testing.assert_allclose(
        ellipse.residuals([[60.5, 20.0], [10.0, -29.0]]), [0.5, -1.0], atol=0.02
    )


def test_points_on_a_line_or_too_few_are_no_ellipse():
    line = np.column_stack([np.arange(20.0), 2.0 * np.arange(20.0)])
    for fit in (fit_paper, Ellipse.fit):
        assert fit(line) is None
        assert fit(line[:4]) is None
    with pytest.raises(ValueError, match="finite"):
        fit_paper([[0.0, np.nan]] * 9)


def test_shape_and_axes_say_the_same():
    ellipse = Ellipse(np.array([1.0, 2.0]), (30.0, 10.0), -0.7)
    again = Ellipse.from_shape(ellipse.shape)
    np.testing.assert_allclose(again.semi_axes_px, (30.0, 10.0))
    assert again.angle_rad == pytest.approx(-0.7)
    np.testing.assert_allclose(ellipse.residuals(ellipse.points(50)), 0.0, atol=1e-9)
