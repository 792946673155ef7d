"""The table of the normal distribution function against scipy's."""

import numpy as np
from scipy.special import ndtr

from rendezview.geometry.normal_table import REACH, normal_cdf


def test_table_equals_scipy_to_a_millionth():
    z = np.random.default_rng(1).uniform(-REACH - 1.0, REACH + 1.0, 5000)
    table = np.array([normal_cdf(value) for value in z])
    # Linear between entries: at most density' / 8 of the spacing squared, 0.242 / 8 / 200².
    np.testing.assert_allclose(table, ndtr(z), rtol=0.0, atol=1e-6)


def test_table_ends_at_nothing_and_one():
    assert normal_cdf(-REACH) == 0.0
    assert normal_cdf(REACH) == 1.0
    assert normal_cdf(-1e300) == 0.0
    assert normal_cdf(1e300) == 1.0
    assert normal_cdf(0.0) == 0.5
