"""The fit of the confidence of poses, on answers whose odds are known."""

import numpy as np
import pytest

from experiments.pose.confidence_fit import WEIGHT_OF_WRONG, fitted, left_out
from rendezview.sensors.appearance.model.error_model import CONFIDENCE_FEATURES

TRUE = np.array([-3.0, 4.0, -1.0, -2.0, 5.0, 1.0, 2.0])


def answers(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    features = np.column_stack(
        [np.ones(count), rng.uniform(0.0, 1.0, (count, len(CONFIDENCE_FEATURES) - 1))]
    )
    return features, rng.random(count) < 1.0 / (1.0 + np.exp(-features @ TRUE))


def test_the_odds_of_drawn_answers_are_found_but_for_the_weight_of_wrong_ones():
    found = fitted(*answers(40_000, 1))
    assert found[1:] == pytest.approx(TRUE[1:], abs=0.25)
    assert found[0] == pytest.approx(TRUE[0] - np.log(WEIGHT_OF_WRONG), abs=0.25)


def test_a_craft_that_is_left_out_is_judged_by_the_others():
    features, right = answers(2_000, 2)
    number = np.arange(2_000) % 20
    lying = number == 7
    last = np.ones(len(number), dtype=bool)
    one = left_out(features, np.where(lying, ~right, right), last, number)
    other = left_out(features, right, last, number)
    fold = number % 5 == 2
    assert one[fold] == pytest.approx(other[fold])
    assert np.abs(one[~fold] - other[~fold]).max() > 0.01
