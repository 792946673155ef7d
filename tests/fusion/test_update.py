"""The update beside the textbook, model by model."""

import math

import numpy as np
import pytest
from tests.fusion.test_prediction import covariance_of, exp, models, nominal, state_of

from rendezview.fusion.update import (
    Comparison,
    compared,
    corrected,
    jitter_step,
    log_mean,
    renewed,
    white_share,
)


def beside(of_models):
    """A state with these models; its nominal motion does not count."""
    return state_of(nominal(np.random.default_rng(0)), of_models)


def a_measurement(seed, k=5, n=24, count=4):
    """Models, design, noise and residual."""
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((k, n))
    design[:, 9:12] = 0.0  # a velocity is never seen
    return models(rng, count, n), design, covariance_of(rng, k), rng.standard_normal(k)


def test_a_measurement_beside_each_model_is_that_of_numpy():
    (x, p, weights), design, noise, residual = a_measurement(7)
    found = compared(beside((x, p, weights)), design, noise, residual)
    assert found is not None
    offs = residual - x @ design.T
    spreads = design @ p @ design.T + noise
    heights = -0.5 * (np.linalg.slogdet(spreads)[1] + 5.0 * math.log(2.0 * math.pi))
    squared = np.array(
        [off @ np.linalg.solve(s, off) for off, s in zip(offs, spreads, strict=True)]
    )
    assert found.logs == pytest.approx(heights - 0.5 * squared)
    assert found.total == pytest.approx(math.log(weights @ np.exp(heights - 0.5 * squared)))
    assert found.peak == pytest.approx(weights @ heights)
    assert found.nis == pytest.approx(weights @ squared)
    assert found.innovation == pytest.approx(weights @ offs)
    assert found.across == pytest.approx(p @ design.T)
    for lower, white, spread, off in zip(found.lowers, found.whites, spreads, offs, strict=True):
        assert lower == pytest.approx(np.linalg.cholesky(spread))
        assert white == pytest.approx(np.linalg.solve(np.linalg.cholesky(spread), off))


def test_biases_that_lose_memory_are_those_of_numpy():
    (x, p, _), kept = a_measurement(9)[0], np.array([0.3, 1.0, 0.8])
    fade = np.ones(24)
    fade[19:22] = kept
    after = renewed(beside((x, p, np.ones(4))), 19, kept)
    assert after.deviations == pytest.approx(x * fade)
    assert after.covariances == pytest.approx(p * np.outer(fade, fade) + np.diag(1.0 - fade**2))


def test_a_covariance_that_is_not_one_fits_nothing():
    (x, p, weights), design, noise, residual = a_measurement(8)
    assert compared(beside((x, p, weights)), design, noise - 1e3 * np.eye(5), residual) is None


def test_a_correction_is_that_of_the_textbook_in_each_model():
    (x, p, weights), design, noise, residual = a_measurement(9)
    x *= 0.01  # so that a rotation vector is nearly a vector
    state = nominal(np.random.default_rng(9))
    seen = compared(beside((x, p, weights)), design, noise, 0.01 * residual)
    found = corrected(state_of(state, (x, p, weights)), seen)
    likely = weights * np.exp(seen.logs)
    likely /= likely.sum()
    assert found.weights == pytest.approx(likely)
    after = np.empty_like(x)
    for m in range(4):
        spread = design @ p[m] @ design.T + noise
        gain = np.linalg.solve(spread, design @ p[m]).T
        after[m] = x[m] + gain @ (0.01 * residual - design @ x[m])
        assert found.covariances[m] == pytest.approx((np.eye(24) - gain @ design) @ p[m], abs=1e-12)
        assert np.array_equal(found.covariances[m], found.covariances[m].T)
    mean = likely @ after
    assert found.rotation == pytest.approx(exp(mean[:3]) @ state[0], abs=1e-12)
    for k in range(1, 4):
        assert found.nominal[k] == pytest.approx(state[k] + mean[3 * k : 3 * k + 3])
    # The motion's mean is in the nominal state now; jitter, acceleration, biases stay.
    assert likely @ found.deviations[:, :12] == pytest.approx(np.zeros(12), abs=1e-12)
    assert found.deviations[:, 12:] == pytest.approx(after[:, 12:], abs=1e-12)
    assert found.deviations[:, :12] == pytest.approx(after[:, :12] - mean[:12], abs=1e-12)


def test_a_model_never_dies_out():
    (x, p, weights), design, noise, residual = a_measurement(10)
    logs = np.array([0.0, -1e4, -1e4, -1.0])
    seen = compared(beside((x, p, weights)), design, noise, residual)._replace(logs=logs)
    after = corrected(beside((x, p, weights)), seen)
    assert after.weights.min() > 5e-6
    assert after.weights.sum() == pytest.approx(1.0)


def of_one_model(lower, white):
    """A comparison with one model, of which L and the innovation in its units count."""
    return Comparison(0.0, 0.0, 0.0, white, np.zeros(1), white, lower[None], white[None])


def share_by_numpy(shares, root, weights, spreads, offs):
    out = np.zeros(len(shares))
    for weight, spread, off in zip(weights, spreads, offs, strict=True):
        along = (root.T @ np.linalg.solve(spread, off)) ** 2
        size = np.diag(root.T @ np.linalg.solve(spread, root))
        out += weight * (along - size) * shares**2
    return np.concatenate([np.full(3, out[:3].mean()), np.full(len(out) - 3, out[3:].mean())])


@pytest.mark.parametrize("k", [5, 6])
def test_a_step_of_the_white_share_is_that_of_numpy(k):
    (x, p, weights), design, noise, residual = a_measurement(11, k)
    root, shares = np.linalg.cholesky(noise), np.linspace(0.2, 0.9, k)
    seen = compared(beside((x, p, weights)), design, noise, residual)
    spreads, offs = design @ p @ design.T + noise, residual - x @ design.T
    found = white_share(shares, root, weights, seen)
    assert found == pytest.approx(share_by_numpy(shares, root, weights, spreads, offs))


def test_the_white_share_rests_at_the_truth():
    """Innovations of S as taken teach nothing in the mean; larger ones raise it."""
    rng = np.random.default_rng(12)
    root, shares = np.linalg.cholesky(covariance_of(rng, 6)), np.full(6, 0.4)
    lower = np.linalg.cholesky(covariance_of(rng, 6) + root @ root.T)
    for scale, least, most in ((1.0, -0.01, 0.01), (1.5, 0.02, 1.0), (0.5, -1.0, -0.02)):
        steps = [
            white_share(
                shares, root, np.ones(1), of_one_model(lower, scale * rng.standard_normal(6))
            )
            for _ in range(4000)
        ]
        mean = np.mean(steps, axis=0)
        assert np.all((least < mean) & (mean < most)), scale


@pytest.mark.parametrize(
    ("kinds", "own"),
    [(1, [0.2, 0.3, 0.4, 0.1]), (2, [0.4, 0.2, 0.3, 0.1]), (2, [0.1, 0.8, 0.05, 0.05])],
)
def test_a_step_of_the_jitter_is_that_of_numpy(kinds, own):
    """By the models of the first jitter, or by all where those are unlikely."""
    (x, p, _), design, noise, residual = a_measurement(13, 6)
    weights = np.array(own)
    seen = compared(beside((x, p, weights)), design, noise, residual)
    gained = 0.7
    found = jitter_step(design, weights, seen, gained, kinds)
    first = np.where(np.arange(4) % kinds == 0, weights, 0.0)
    if first.sum() < 0.2:
        first = weights
    whole = gained * design[:, :3] @ design[:, :3].T
    slope = curvature = 0.0
    for weight, spread, off in zip(
        first / first.sum(), design @ p @ design.T + noise, residual - x @ design.T, strict=True
    ):
        inverse = np.linalg.inv(spread)
        z = inverse @ off
        slope += weight * (z @ whole @ z - np.trace(inverse @ whole))
        curvature += weight * np.trace(inverse @ whole @ inverse @ whole)
    assert found == pytest.approx(slope / curvature)
    assert jitter_step(0.0 * design, weights, seen, gained, kinds) == 0.0


def test_the_step_of_the_jitter_leads_to_the_truth():
    rng = np.random.default_rng(14)
    design, rest = rng.standard_normal((6, 20)), covariance_of(rng, 6)
    true, taken, gained = 0.5, 0.2, 0.8
    seen = gained * design[:, :3] @ design[:, :3].T
    real = np.linalg.cholesky(rest + true * seen)
    lower = np.linalg.cholesky(rest + taken * seen)
    steps = [
        jitter_step(
            design, np.ones(1),
            of_one_model(lower, np.linalg.solve(lower, real @ rng.standard_normal(6))), gained, 1,
        )
        for _ in range(6000)
    ]  # fmt: skip
    assert np.mean(steps) == pytest.approx(true - taken, rel=0.1)


def test_the_logarithm_of_a_mean_holds_for_any_size():
    weights = np.array([0.2, 0.5, 0.3])
    for shift in (0.0, -5000.0, 5000.0):
        logs = np.array([0.3, -1.0, 2.0]) + shift
        expected = shift + np.log(weights @ np.exp(logs - shift))
        assert log_mean(weights, logs) == pytest.approx(expected)
