"""The trees behind the confidence, beside scikit-learn's."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.ensemble import RandomForestClassifier

from rendezview.sensors.appearance.judge.probability_forest import ProbabilityForest


def test_probabilities_are_those_of_scikit_learn():
    rng = np.random.default_rng(3)
    features = rng.standard_normal((300, 5)).astype(np.float32)
    good = features[:, 0] + 0.5 * rng.standard_normal(300) > 0.2
    weight = np.where(good, 1.0, 1.5)
    fit = RandomForestClassifier(12, min_samples_leaf=4, random_state=0)
    fit.fit(features, good, sample_weight=weight)
    forest = ProbabilityForest.of([tree.tree_ for tree in fit.estimators_])
    found = [forest.probability(one) for one in features]
    assert found == pytest.approx(fit.predict_proba(features)[:, 1], abs=1e-6)


def test_a_feature_at_the_threshold_goes_left():
    features = np.array([[0.1], [0.2], [0.3], [0.4]], dtype=np.float32)
    fit = RandomForestClassifier(1, bootstrap=False).fit(features, [False, False, True, True])
    forest = ProbabilityForest.of([fit.estimators_[0].tree_])
    limit = forest.threshold[0]
    assert 0.2 < limit < 0.3
    assert forest.probability(np.array([limit])) == 0.0
    assert forest.probability(np.array([np.nextafter(limit, np.float32(1.0))])) == 1.0
