"""Small loops that stand for functions of numpy: they compile in a tenth of the time."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.estimation.linear_algebra import (
    copy_matrix_into,
    descending,
    largest_at,
    largest_size,
)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 14, 100, 1000])
def test_descending_is_a_stable_sort_of_the_negative(count):
    rng = np.random.default_rng(count)
    for values in (rng.standard_normal(count), np.round(rng.uniform(0.0, 9.0, count))):
        assert np.array_equal(descending(values), np.argsort(-values, kind="stable"))


def test_the_first_of_the_largest_is_named():
    assert largest_at(np.array([-np.inf, 2.0, 1.0, 2.0])) == 1
    assert largest_at(np.array([-np.inf, -np.inf])) == 0


def test_largest_size_is_that_of_numpy():
    rng = np.random.default_rng(3)
    for _ in range(20):
        values = rng.standard_normal(6)
        assert largest_size(values) == np.max(np.abs(values))
    values[2] = np.nan
    assert np.isnan(largest_size(values))
    assert largest_size(np.empty(0)) == 0.0


def test_a_matrix_is_copied_into_the_rows_and_columns_given():
    values = np.arange(6.0).reshape(2, 3)
    out = np.full((3, 5), -1.0)
    copy_matrix_into(values, out[1:, 2:])
    assert np.array_equal(out[1:, 2:], values)
    assert (out == -1.0).sum() == 9
