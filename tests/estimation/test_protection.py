"""Protection levels: bounds of Student's t, other answers, drifts."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.estimation.protection import Drift, Overbound, shared
from rendezview.geometry.pose import Array

RISKS = (1e-1, 1e-2, 1e-3)


def _errors(covariance: Array, bound: Overbound, count: int) -> Array:
    """(N, D) errors of Student's t distribution."""
    rng = np.random.default_rng(3)
    normal = rng.multivariate_normal(np.zeros(len(covariance)), covariance, count)
    return bound.scale * normal / np.sqrt(rng.chisquare(bound.degrees, (count, 1)) / bound.degrees)


@pytest.mark.parametrize(
    "axes", [(1.0, 1.0, 1.0), (1.0, 0.3, 0.1), (1.0, 1e-4, 1e-4), (4.0, 3.0, 0.1)]
)
@pytest.mark.parametrize("degrees", [3.0, 200.0])
def test_the_radius_is_exceeded_no_more_often_than_the_risk(axes, degrees):
    bound = Overbound(1.7, degrees)
    covariance = np.diag(axes)
    lengths = np.linalg.norm(_errors(covariance, bound, 400_000), axis=1)
    for risk in RISKS:
        share = float(np.mean(lengths > bound.radius(covariance)(risk)))
        assert share < risk * (1.0 + 4.0 / np.sqrt(risk * len(lengths)))
        assert share > 0.5 * risk  # and it is no larger than it must be


def test_equal_axes_give_the_exact_radius():
    bound = Overbound(1.0, 1e7)  # Gaussian: chi with three degrees of freedom
    assert bound.radius(np.eye(3))(1e-3) == pytest.approx(4.0331, abs=1e-3)
    assert bound.radius(np.diag([1.0, 1e-12, 1e-12]))(1e-3) == pytest.approx(3.2905, abs=1e-3)


def test_each_axis_is_left_with_the_probability_of_the_risk():
    bound = Overbound(1.3, 4.0)
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    errors = np.abs(_errors(covariance, bound, 400_000))
    for risk in RISKS:
        share = (errors > bound.each(covariance, risk)).mean(axis=0)
        assert share == pytest.approx([risk, risk], rel=0.2)


def test_a_bias_is_added_in_its_unit():
    plain, biased = Overbound(1.0, 5.0), Overbound(1.0, 5.0, 0.02)
    assert biased.radius(np.eye(3), 30.0)(1e-3) - plain.radius(np.eye(3))(1e-3) == pytest.approx(
        0.6
    )
    more = biased.each(np.eye(3), 1e-3, 30.0) - plain.each(np.eye(3), 1e-3)
    assert more == pytest.approx([0.6] * 3)
    with pytest.raises(ValueError, match="bias"):
        Overbound(1.0, 5.0, -0.1)


@pytest.mark.parametrize(("scale", "degrees"), [(0.0, 3.0), (1.0, -1.0), (np.nan, 3.0)])
def test_an_overbound_refuses_numbers_that_are_none(scale, degrees):
    with pytest.raises(ValueError, match="positive"):
        Overbound(scale, degrees)


def _tail(risk: float) -> float:
    """Of an error with P(error > L) = exp(−L)."""
    return -float(np.log(risk))


def _level(alternatives: list[tuple[float, float]], risk: float) -> float:
    return shared(_tail, alternatives, risk).level(_tail)


def _risk_at(length: float, alternatives: list[tuple[float, float]]) -> float:
    return sum(p for d, p in alternatives if d > length) + float(np.exp(-length))


@pytest.mark.parametrize(
    ("alternatives", "level"),
    [
        ([], _tail(1e-3)),  # the radius
        ([(90.0, 4e-4)], _tail(6e-4)),  # an unlikely one takes its share of the risk
        ([(90.0, 4e-2)], 90.0),  # one that is likelier than the risk is inside
        ([(np.inf, 1e-2)], np.inf),  # an answer that is anywhere leaves no level
        ([(2.0, 0.5)], _tail(1e-3)),  # a near one costs nothing
    ],
)
def test_the_level_keeps_the_risk_beside_alternatives(alternatives, level):
    assert _level(alternatives, 1e-3) == pytest.approx(level)


def test_the_level_is_the_least_that_keeps_the_risk():
    rng = np.random.default_rng(5)
    for _ in range(200):
        count = int(rng.integers(0, 5))
        chances = 10.0 ** rng.uniform(-6, -1, count)
        others = list(zip(rng.uniform(0.0, 30.0, count), chances, strict=True))
        risk = 10.0 ** rng.uniform(-5, -2)
        level = _level(others, risk)
        assert _risk_at(level, others) <= risk * (1.0 + 1e-9)
        assert _risk_at(level * (1.0 - 1e-6), others) > risk * (1.0 - 1e-9)


def test_a_drift_is_found_and_noise_is_not():
    rng = np.random.default_rng(7)
    quiet = drifting = Drift.none(6)
    for _ in range(500):
        quiet = quiet.after(rng.normal(size=6), 0.5, 4.0)
    offset = np.array([0, 0, 0, 0, -1.5, 0])
    for _ in range(30):
        drifting = drifting.after(rng.normal(size=6) + offset, 0.5, 4.0)
    assert quiet.largest < 12.0
    assert drifting.largest > 20.0
    assert drifting.below.argmax() == 4


def test_one_outlier_is_no_drift():
    assert Drift.none(6).after(np.full(6, 1000.0), 0.5, 4.0).largest == pytest.approx(3.5)
