"""Errors that hardly change between readings: they are no white noise."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.estimation.rates import RateBank
from rendezview.estimation.slow_error import SlowError
from rendezview.geometry.pose import Pose

NOISE, STEP_S = 1e-8 * np.eye(6), 0.1
SLOW = np.diag([1.0, 4.0, 9.0, 1.0, 1.0, 1.0])


def test_an_error_of_two_readings_counts_as_white_noise_of_its_density():
    error = SlowError()
    assert error.add(0.0, SLOW) == (None, False)
    for time_s, wanted in ((0.1, 19.0), (0.6, 3.0), (2.6, 0.0)):
        more, _ = error.add(time_s, SLOW)
        np.testing.assert_allclose(more, wanted * SLOW, atol=1e-9)


def test_an_error_of_a_single_reading_is_chance_and_one_that_ends_is_forgotten_slowly():
    error = SlowError()
    began = []
    for k, size in enumerate((0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0)):
        more, begins = error.add(0.1 * k, size * SLOW)
        began.append(begins)
        assert (more is not None and more.any()) == (k >= 4)
    assert began == [False, False, False, False, True, False, False]
    np.testing.assert_allclose(more, 19.0 * np.exp(-0.1) * SLOW)
    assert error.add(9.0, SLOW)[1] is False
    assert error.add(9.1, SLOW)[1] is True  # again
    error.clear()
    assert error.add(9.2, SLOW)[0] is None


def test_readings_shortly_before_are_widened():
    readings = [(t, Pose.identity(), NOISE) for t in (0.0, 0.4, 1.0, 1.2)]
    widened = list(SlowError.widened(1.5, SLOW, readings))
    wider = [(one[2] - NOISE)[0, 0] for one in widened]
    np.testing.assert_allclose(wider, [0.0, 0.0, 2.0 / 0.6, 10.0])
    first = next(iter(SlowError.widened(0.1, SLOW, readings)))
    np.testing.assert_allclose(first[2], NOISE + SLOW)


@pytest.mark.parametrize("creeps_s", [1.0, 3.0])
def test_the_rates_of_readings_that_drift_have_the_errors_that_they_claim(creeps_s):
    """Errors (σ of the last 0.02) grow from what nobody notices; the target is at rest."""
    values = []
    for seed in range(30):
        rng, bank = np.random.default_rng(seed), RateBank()
        last, found = rng.normal(0.0, 0.02, 6), None
        for t in np.arange(-1.0, creeps_s + 0.5 * STEP_S, STEP_S):
            share = min(max(t, 0.0) / creeps_s, 1.0)
            slow = (0.02 * share) ** 2 * np.eye(6) * (share > 0.25)
            off = share * last + rng.normal(0.0, 1e-4, 6)
            pose = Pose.identity().perturbed(off)
            found = bank.add(1.0 + t, pose, NOISE + slow, slow)
        values.append(found.rates @ np.linalg.solve(found.covariance, found.rates))
    assert np.mean(values) < 6.0
