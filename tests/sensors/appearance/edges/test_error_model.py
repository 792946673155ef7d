"""The coefficients fitted to data: their file."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.container import read_container, write_container
from rendezview.sensors.appearance.model.error_model import (
    CONFIDENCE_FEATURES,
    INFLATION_FEATURES,
    PACKAGED,
    ErrorModel,
    inflation_features,
)


def test_the_packaged_file_says_what_it_was_fitted_to_and_is_read_bit_for_bit():
    model = ErrorModel.packaged()
    assert model.log_odds.shape == (len(CONFIDENCE_FEATURES),)
    assert model.log_inflation.shape == (len(INFLATION_FEATURES),)
    assert model.provenance["log_odds"]["random_craft"] >= 40
    assert model.provenance["log_inflation"]["logs"]
    text = json.dumps(model.record())
    assert json.loads(text) == json.loads(PACKAGED.read_text(encoding="utf-8"))
    again = ErrorModel.of_record(json.loads(text))
    assert again.log_odds.tobytes() == model.log_odds.tobytes()
    assert again.log_inflation.tobytes() == model.log_inflation.tobytes()


def test_confidence_is_the_logistic_of_the_odds_and_stays_finite():
    model = ErrorModel.packaged()
    features = np.random.default_rng(2).uniform(0.0, 1.0, len(CONFIDENCE_FEATURES))
    odds = sum(a * b for a, b in zip(features, model.log_odds, strict=True))
    assert model.confidence(features) == pytest.approx(1.0 / (1.0 + np.exp(-odds)))
    most, least = (model.confidence(sign * 1e6 * model.log_odds) for sign in (1.0, -1.0))
    assert (least, most) == (pytest.approx(0.0, abs=1e-12), pytest.approx(1.0, abs=1e-12))


def test_a_pose_with_less_of_its_outline_or_a_larger_residual_gets_a_larger_covariance():
    model = ErrorModel.packaged()
    good = model.inflation(0.95, 0.1, 1.0)
    assert np.log(good) == pytest.approx(
        model.log_inflation @ inflation_features(0.95, 0.1, 1.0), rel=1e-12
    )
    assert model.inflation(0.6, 0.1, 1.0) > good
    assert model.inflation(0.95, 0.4, 1.0) > good
    assert model.inflation(0.95, 0.1, 0.0) > good


@pytest.mark.parametrize("wrong", ["missing", "unknown", "text"])
def test_coefficients_that_do_not_fit_the_features_are_refused(wrong):
    record = ErrorModel.packaged().record()
    if wrong == "missing":
        del record["log_odds"]["dark"]
    elif wrong == "unknown":
        record["log_odds"]["colour"] = 1.0
    else:
        record["log_odds"]["dark"] = "much"
    with pytest.raises(ValueError, match=r"error_model\.log_odds|could not convert"):
        ErrorModel.of_record(record)


def test_a_model_that_carries_coefficients_of_an_earlier_version_is_read(refining_model, tmp_path):
    refining_model.save(tmp_path / "now.rvm")
    header, arrays = read_container(tmp_path / "now.rvm")
    write_container(tmp_path / "before.rvm", {**header, "error_model": {"log_odds": {}}}, arrays)
    assert ViewModel.load(tmp_path / "before.rvm").contours is not None


def test_a_coefficient_that_is_not_finite_is_refused():
    record = ErrorModel.packaged().record()
    record["log_inflation"]["dark"] = float("inf")
    with pytest.raises(ValueError, match="finite"):
        ErrorModel.of_record(record)
