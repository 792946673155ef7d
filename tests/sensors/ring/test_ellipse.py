"""The ellipse as a result: its numbers, their covariance, its points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.sensors.ring.plain_fit import geometric_fit, shape_through

from rendezview.sensors.ring import Ellipse


def points_of(a, b, angle, arc, count, sigma, rng):
    t = 1.0 + np.linspace(0.0, arc, count, endpoint=False)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = np.column_stack([a * np.cos(t), b * np.sin(t)]) @ turn.T + [300.0, 200.0]
    return points + rng.normal(0.0, sigma, points.shape)


@pytest.mark.parametrize("angle", [-1.2, -0.3, 0.4, 1.5])
def test_a_shape_has_the_axes_and_the_sign_of_the_angle(angle):
    rng = np.random.default_rng(0)
    points = points_of(120.0, 60.0, angle, 2.0 * math.pi, 60, 0.0, rng)
    ellipse = Ellipse.from_shape(shape_through(points))
    np.testing.assert_allclose(ellipse.centre_px, [300.0, 200.0], atol=1e-5)
    np.testing.assert_allclose(ellipse.semi_axes_px, [120.0, 60.0], atol=1e-5)
    assert ellipse.angle_rad == pytest.approx(angle, abs=1e-6)


def test_the_covariance_of_axes_and_angle_is_that_of_the_shape():
    rng = np.random.default_rng(2)
    odd = []
    for _ in range(200):
        ellipse = geometric_fit(points_of(120.0, 60.0, 0.4, 2.0 * math.pi, 200, 0.3, rng))
        error = np.array([*(ellipse.centre_px - [300, 200]), ellipse.semi_axes_px[0] - 120,
                          ellipse.semi_axes_px[1] - 60, ellipse.angle_rad - 0.4])  # fmt: skip
        odd.append(error @ np.linalg.solve(ellipse.covariance, error) / 5.0)
    assert 0.8 < np.mean(odd) < 1.25


def test_a_circle_has_a_finite_covariance_although_its_angle_means_nothing():
    rng = np.random.default_rng(3)
    ellipse = geometric_fit(points_of(80.0, 80.0, 0.0, 2.0 * math.pi, 100, 0.05, rng))
    assert np.isfinite(ellipse.covariance).all()
    assert ellipse.covariance[4, 4] <= math.pi**2 / 12.0 + 1e-9
    assert np.linalg.eigvalsh(ellipse.covariance).min() > -1e-12


def test_shape_and_axes_say_the_same():
    ellipse = Ellipse(np.array([1.0, 2.0]), (30.0, 10.0), -0.7)
    again = Ellipse.from_shape(ellipse.shape)
    np.testing.assert_allclose(again.semi_axes_px, (30.0, 10.0))
    assert again.angle_rad == pytest.approx(-0.7)
    np.testing.assert_allclose(shape_through(ellipse.points(50)), ellipse.shape, atol=1e-9)
