"""The damped least squares against scipy's, on problems with known answers."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from rendezview.estimation.least_squares import Options, damped_step, minimise, tukey_weight

TIMES = np.linspace(0.0, 3.0, 20)
TRUE = np.array([2.0, -0.7])


def _residuals(p):
    with np.errstate(over="ignore"):
        return TRUE[0] * np.exp(TRUE[1] * TIMES) - p[0] * np.exp(p[1] * TIMES)


def _slopes(p):
    e = np.exp(p[1] * TIMES)
    return np.column_stack([e, p[0] * TIMES * e])


def _cost(p):
    r = _residuals(p)
    return float(r @ r)


def _equations(p):
    r, j = _residuals(p), _slopes(p)
    return float(r @ r), j.T @ j, j.T @ r


def test_an_exponential_is_fitted_from_far_away():
    options = Options(iterations=200, least_gain=1e-15)
    found = minimise(_equations, np.add, np.array([0.5, 0.4]), cost=_cost, options=options)
    assert found is not None
    assert found.converged
    np.testing.assert_allclose(found.at, TRUE, rtol=1e-6)
    peer = least_squares(_residuals, [0.5, 0.4], method="lm")
    np.testing.assert_allclose(found.at, peer.x, rtol=1e-5)


def test_the_cost_of_the_equations_serves_as_well_as_one_of_its_own():
    start = np.array([0.5, 0.4])
    one, other = (
        minimise(_equations, np.add, start),
        minimise(_equations, np.add, start, cost=_cost),
    )
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.at, other.at)
    assert one.iterations == other.iterations


def test_the_cost_never_rises():
    costs = []

    def watched(p):
        found = _equations(p)
        costs.append(found[0])
        return found

    minimise(watched, np.add, np.array([0.5, 0.4]), cost=_cost)
    assert all(b <= a * (1.0 + 1e-12) for a, b in pairwise(costs))


def test_a_start_without_a_finite_cost_is_none():
    def nowhere(p):
        return np.inf, np.eye(2), np.zeros(2)

    assert minimise(nowhere, np.add, np.zeros(2)) is None


def test_singular_equations_end_at_the_start():
    def flat(p):
        return 1.0, np.zeros((2, 2)), np.zeros(2)

    found = minimise(flat, np.add, np.ones(2))
    assert found is not None
    np.testing.assert_array_equal(found.at, np.ones(2))


def test_a_damped_step_equals_numpy():
    a = np.random.default_rng(1).normal(size=(4, 6))
    normal, right = a @ a.T, a @ np.ones(6)
    out = np.empty(4)
    assert damped_step(normal, right, 0.3, np.empty((4, 4)), out)
    expected = np.linalg.solve(normal + 0.3 * np.diag(np.diag(normal)), right)
    np.testing.assert_allclose(out, expected, rtol=1e-10)


@pytest.mark.parametrize(
    ("residual", "weight"), [(0.0, 1.0), (0.5, 0.5625), (1.0, 0.0), (9.0, 0.0)]
)
def test_tukey_weight(residual, weight):
    assert tukey_weight(residual, 1.0) == pytest.approx(weight)
