"""The algebra of P3P against numpy's, its twin."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.estimation import conic_pencil as pencil


def matrix(c) -> np.ndarray:
    return np.array([[c[0], c[1], c[3]], [c[1], c[2], c[4]], [c[3], c[4], c[5]]])


def conics(count: int):
    return [tuple(map(float, c)) for c in np.random.default_rng(1).normal(size=(count, 6))]


def pair_of_lines(first, second):
    m = 0.5 * (np.outer(first, second) + np.outer(second, first))
    return m[0, 0], m[0, 1], m[1, 1], m[0, 2], m[1, 2], m[2, 2]


def test_determinants_equal_numpy():
    a, b = conics(2)
    assert pencil.determinant(a) == pytest.approx(np.linalg.det(matrix(a)))
    adjugate = np.linalg.inv(matrix(a)) * np.linalg.det(matrix(a))
    np.testing.assert_allclose(matrix(pencil.adjugate(a)), adjugate, atol=1e-12)
    assert pencil.mixed_determinant(a, b) == pytest.approx(np.trace(adjugate @ matrix(b)))


def test_a_blend_and_the_unit_of_a_conic():
    a, b = conics(2)
    np.testing.assert_allclose(pencil.blend(a, 2.0, b, -3.0), 2.0 * np.array(a) - 3.0 * np.array(b))
    assert max(map(abs, pencil.unit_conic(a))) == pytest.approx(1.0)


def test_the_isolated_root_is_a_root_and_the_one_apart():
    rng = np.random.default_rng(2)
    for roots in rng.normal(size=(50, 3)):
        c3, c2, c1, c0 = np.poly(roots)
        found = pencil.isolated_root(c3, c2, c1, c0)
        ordered = np.sort(roots)
        apart = ordered[0] if ordered[1] - ordered[0] > ordered[2] - ordered[1] else ordered[2]
        assert found == pytest.approx(apart, abs=1e-6)


def test_two_lines_are_split_again():
    first, second = np.array([1.0, 2.0, -0.5]), np.array([-0.3, 1.0, 0.7])
    real, one, other = pencil.split_lines(pair_of_lines(first, second))
    assert real
    for line in (one, other):
        apart = [
            np.linalg.norm(np.cross(line, of)) / np.linalg.norm(line) for of in (first, second)
        ]
        assert min(apart) < 1e-12


def test_a_line_meets_a_circle_in_two_points():
    circle = (1.0, 0.0, 1.0, 0.0, 0.0, -4.0)
    for point in pencil.meet((1.0, 1.0, -1.0), circle):
        assert np.hypot(*point) == pytest.approx(2.0)
        assert sum(point) == pytest.approx(1.0)
