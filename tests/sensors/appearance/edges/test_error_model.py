"""The coefficients fitted to data: their file, and a model that carries its own."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

from rendezview.errors import RendezviewError
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
    assert model.log_odds.shape == (2, 2, len(CONFIDENCE_FEATURES))
    assert model.log_inflation.shape == (len(INFLATION_FEATURES),)
    assert model.provenance["logs"]
    text = json.dumps(model.record())
    assert json.loads(text) == json.loads(PACKAGED.read_text(encoding="utf-8"))
    again = ErrorModel.of_record(json.loads(text))
    assert again.log_odds.tobytes() == model.log_odds.tobytes()
    assert again.log_inflation.tobytes() == model.log_inflation.tobytes()


def test_confidence_is_the_logistic_of_the_odds_and_stays_finite():
    model = ErrorModel.packaged()
    rng = np.random.default_rng(2)
    for shading in (False, True):
        for dark in (False, True):
            features = rng.uniform(0.0, 1.0, len(CONFIDENCE_FEATURES))
            row = model.log_odds[int(shading), int(dark)]
            odds = sum(a * b for a, b in zip(features, row, strict=True))
            expected = 1.0 / (1.0 + np.exp(-odds))
            assert model.confidence(features, shading=shading, dark=dark) == pytest.approx(expected)
    most = model.confidence(1e6 * model.log_odds[1, 1], shading=True, dark=True)
    least = model.confidence(-1e6 * model.log_odds[1, 1], shading=True, dark=True)
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


def test_training_writes_the_packaged_error_model_and_an_own_one_survives_the_file(
    refining_model, tmp_path
):
    carried = refining_model.error_model
    assert carried is not None
    assert carried.record() == ErrorModel.packaged().record()
    own = replace(carried, log_inflation=carried.log_inflation + 1.0 / 3.0)
    replace(refining_model, error_model=own).save(tmp_path / "own.rvm")
    read = ViewModel.load(tmp_path / "own.rvm").error_model
    assert read is not None
    assert read.log_inflation.tobytes() == own.log_inflation.tobytes()
    assert read.log_odds.tobytes() == own.log_odds.tobytes()
    assert dict(read.provenance) == dict(own.provenance)


def test_a_model_made_before_models_carried_one_is_read(refining_model, tmp_path):
    refining_model.save(tmp_path / "now.rvm")
    header, arrays = read_container(tmp_path / "now.rvm")
    del header["error_model"]
    write_container(tmp_path / "before.rvm", header, arrays)
    assert ViewModel.load(tmp_path / "before.rvm").error_model is None


@pytest.mark.parametrize("wrong", ["missing", "unknown", "text"])
def test_a_file_whose_coefficients_do_not_fit_the_features_is_refused(
    refining_model, tmp_path, wrong
):
    refining_model.save(tmp_path / "now.rvm")
    header, arrays = read_container(tmp_path / "now.rvm")
    header = copy.deepcopy(header)
    coefficients = header["error_model"]["log_inflation"]
    if wrong == "missing":
        del coefficients["dark"]
    elif wrong == "unknown":
        coefficients["colour"] = 1.0
    else:
        coefficients["dark"] = "much"
    write_container(tmp_path / "wrong.rvm", header, arrays)
    with pytest.raises(RendezviewError, match="does not hold together"):
        ViewModel.load(tmp_path / "wrong.rvm")


def test_a_coefficient_that_is_not_finite_is_refused():
    record = ErrorModel.packaged().record()
    record["log_inflation"]["dark"] = float("inf")
    with pytest.raises(ValueError, match="finite"):
        ErrorModel.of_record(record)
