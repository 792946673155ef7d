"""Retrieval: the least of many distances, and signatures of any number of bins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.sensors.appearance.model.shadowed_silhouettes import READING_UNIT, SHADOWED_BINS
from rendezview.sensors.appearance.model.signature import Signature, rebinning
from rendezview.sensors.appearance.outline.retrieval import Retrieval
from rendezview.sensors.appearance.outline.similarity import least

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


@pytest.mark.parametrize("bins", [360, 294, 91, 60])
def test_rebinning_keeps_the_phase_and_the_mean_of_any_number_of_bins(bins):
    angle = 2.0 * np.pi * np.arange(bins) / bins
    readings = 500.0 + 100.0 * np.cos(angle - 0.5) + 30.0 * np.sin(3.0 * angle)
    coarse = readings @ rebinning(bins, SHADOWED_BINS)
    assert coarse.mean() == pytest.approx(500.0, rel=1e-3)
    harmonic = np.fft.rfft(coarse)[1]
    assert np.angle(harmonic) == pytest.approx(-0.5, abs=2e-3)
    assert np.abs(harmonic) * 2.0 / SHADOWED_BINS == pytest.approx(100.0, rel=0.02)


def test_294_bins_keep_their_shadowed_silhouettes(refining_model):
    """The paper's demonstration has 294 bins: half of the starting poses are of sunlit parts."""
    views = refining_model.views
    wide = np.rint(views.readings @ rebinning(refining_model.bins, 294)).astype(np.uint16)
    model = replace(refining_model, views=replace(views, readings=wide, far_change=None))
    retrieval = Retrieval(model)
    lit = model.lit
    entry = int(np.argmax(lit.area_m2))
    readings = lit.readings[entry].astype(np.float32) * np.float32(READING_UNIT)
    signature = Signature(
        np.rint(readings @ rebinning(SHADOWED_BINS, 294)),
        float(lit.area_m2[entry]) / 25.0,
        np.eye(3),
    )
    rotations, _ = retrieval.of(signature, 40)
    true = Rotation.from_quat(lit.quat_wxyz[entry][[1, 2, 3, 0]])
    off = (Rotation.from_matrix(rotations) * true.inv()).magnitude()
    assert np.rad2deg(off.min()) < 5.0
    assert len(Retrieval(replace(model, lit=None)).of(signature, 40)[0]) == 40
