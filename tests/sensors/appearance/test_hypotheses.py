"""Choosing the least of many distances."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.sensors.appearance.edges.retrieval import least

_RNG = np.random.default_rng(5)
_VALUES = {
    "drawn": _RNG.normal(size=50_000),
    "falling": -np.arange(50_000.0),
    "all alike": np.zeros(50_000),
    "the least where no sample is": np.where(np.arange(50_000) % 17 < 2, 5.0, _RNG.random(50_000)),
    "the least where each sample is": np.where(np.arange(50_000) % 17, 5.0, _RNG.random(50_000)),
    "few": _RNG.normal(size=2_500),
}


@pytest.mark.parametrize("name", _VALUES)
def test_the_least_of_many_are_those_that_sorting_finds(name):
    values = _VALUES[name].astype(np.float32)
    places = least(values, 2_000)
    assert len(np.unique(places)) == 2_000
    assert np.all(np.diff(places) > 0)
    assert np.array_equal(np.sort(values[places]), np.sort(values)[:2_000])


def test_fewer_than_asked_for_are_all_of_them():
    assert least(np.array([3.0, 1.0, 2.0], np.float32), 2_000).tolist() == [0, 1, 2]
