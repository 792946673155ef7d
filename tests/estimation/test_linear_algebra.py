"""The compiled solvers against numpy, their twins."""

import numpy as np
import pytest

from rendezview.estimation import linear_algebra


def _positive(n: int, seed: int) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(n, n + 2))
    return a @ a.T


@pytest.mark.parametrize("n", [1, 2, 5, 6, 12])
def test_solvers_equal_numpy(n):
    matrix, right = _positive(n, n), np.random.default_rng(n + 1).normal(size=n)
    lower, out = np.empty((n, n)), np.empty(n)
    expected = np.linalg.solve(matrix, right)
    assert linear_algebra.solve(matrix, right, lower, out)
    np.testing.assert_allclose(out, expected, rtol=1e-8)
    np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(matrix), atol=1e-12)
    linear_algebra.substitute(lower, right, out)
    np.testing.assert_allclose(out, expected, rtol=1e-8)
    assert linear_algebra.solve_scaled(matrix, right, lower, out)
    np.testing.assert_allclose(out, expected, rtol=1e-8)
    inverse = np.empty((n, n))
    assert linear_algebra.invert(matrix, lower, inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-7)


def test_scaling_keeps_unlike_units_apart():
    scale = np.array([1e-6, 1.0, 1e6])
    matrix = _positive(3, 8) * np.outer(scale, scale)
    right, out = scale * np.array([1.0, 2.0, 3.0]), np.empty(3)
    assert linear_algebra.solve_scaled(matrix, right, np.empty((3, 3)), out)
    np.testing.assert_allclose(out, np.linalg.solve(matrix, right), rtol=1e-9)


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), -np.eye(3), np.ones((3, 3))])
def test_a_singular_or_negative_matrix_is_refused(matrix):
    lower, out = np.empty((3, 3)), np.empty(3)
    assert not linear_algebra.cholesky(matrix, lower)
    assert not linear_algebra.solve(matrix, np.ones(3), lower, out)
    assert not linear_algebra.solve_scaled(matrix, np.ones(3), lower, out)
    assert not linear_algebra.invert(matrix, lower, np.empty((3, 3)))


@pytest.mark.parametrize("share", [0.0, 0.31, 0.8, 1.0])
@pytest.mark.parametrize("count", [1, 2, 7, 300])
def test_a_quantile_is_numpys(share, count):
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count), rng.integers(0, 4, count).astype(float)):
        found = linear_algebra.quantile(values, share)
        assert found == pytest.approx(np.quantile(values, share), rel=1e-12, abs=1e-12)


def test_copying_fills_the_other_array():
    out = np.zeros(3)
    linear_algebra.copy_into(np.array([1.0, 2.0, 3.0]), out)
    assert out.tolist() == [1.0, 2.0, 3.0]
