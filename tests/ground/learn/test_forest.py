"""The learner of the voters against plain Python and scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score
from sklearn.tree import DecisionTreeClassifier

from rendezview.sensors.appearance.model.trees import split_entropy
from rendezview_ground.learn.trees.grown_tree import (
    BRANCHLESS,
    LEVELS,
    GrownTree,
    Rules,
    entropies,
    grow,
    split,
)

RULES = Rules(least_split=16, least_leaf=8, least_gain=4.0)


def grown(
    readings: np.ndarray, labels: np.ndarray, drawn: np.ndarray, keys: np.ndarray
) -> GrownTree:
    levels = np.ascontiguousarray(readings.T)
    return grow(levels, labels, drawn, keys, RULES, entropies(len(drawn)))


def samples(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    readings = rng.integers(0, 256, (count, 12), dtype=np.uint8)
    labels = (readings[:, 3] < 120) & (readings[:, 7] > 60)
    return readings, labels ^ (rng.random(count) < 0.05)


@pytest.mark.requirement("RV-TRAIN-3")
def test_split_is_the_best_of_all_thresholds_by_equation_5():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        readings, labels = samples(rng, 200)
        bins, no_keys = np.arange(12), np.zeros(0, np.int64)
        weights = np.where(labels, 1 << 32, 1)
        where, level = split(
            np.ascontiguousarray(readings.T), weights, np.arange(200), bins, no_keys, RULES,
            entropies(200), np.empty(LEVELS, np.int64),
        )  # fmt: skip
        best = (-np.inf, -1, -1)
        for b in range(12):
            for threshold in np.unique(readings[:, b]):
                left = readings[:, b] <= threshold
                if left.sum() < 8 or (~left).sum() < 8:
                    continue
                counts = [[np.sum(labels[s]), np.sum(~labels[s])] for s in (left, ~left)]
                best = max(best, (split_entropy(*counts), b, int(threshold)))
        found = readings[:, where] <= level
        counts = [[np.sum(labels[s]), np.sum(~labels[s])] for s in (found, ~found)]
        assert np.isclose(split_entropy(*counts), best[0])


def test_a_grown_tree_separates_as_scikit_learns_does():
    rng = np.random.default_rng(9)
    readings, labels = samples(rng, 2000)
    fresh, truth = samples(rng, 2000)
    keys = rng.integers(0, 2**31, (255, 12))
    component, threshold, right, on, off = grown(readings, labels, np.arange(2000), keys)
    odds = []
    for row in fresh:
        entry = 0
        while component[entry] != BRANCHLESS:
            entry += 1 if row[component[entry]] <= threshold[entry] else right[entry]
        odds.append(on[entry] / (on[entry] + off[entry]))
    peer = DecisionTreeClassifier(criterion="entropy", min_samples_leaf=8, random_state=0)
    theirs = peer.fit(readings, labels).predict_proba(fresh)[:, 1]
    assert roc_auc_score(truth, odds) > roc_auc_score(truth, theirs) - 0.02
    leaves = component == BRANCHLESS
    assert (on + off)[leaves].sum() == 2000
    assert np.all(right[~leaves] >= 2)


def test_a_tree_has_no_more_entries_than_keys():
    rng = np.random.default_rng(10)
    readings, labels = samples(rng, 2000)
    for most in (1, 7, 31):
        keys = rng.integers(0, 2**31, (most, 12))
        component, _, right, _, _ = grown(readings, labels, rng.integers(0, 2000, 2000), keys)
        assert len(component) <= most
        inner = np.flatnonzero(component != BRANCHLESS)
        assert np.all(inner + right[inner] < len(component))
