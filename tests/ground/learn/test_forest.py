"""The learner of the forest: scikit-learn's forest, decided alike by the runtime."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sklearn.tree import DecisionTreeClassifier

from rendezview.geometry.geodesic import Geodesic
from rendezview.sensors.appearance.model.forest import (
    BINS,
    LEAF,
    ODDS_UNIT,
    ForestTables,
    _ask_each,
)
from rendezview.sensors.appearance.model.signature import roll_readings
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.learn.trees import forest as learner
from rendezview_ground.learn.trees.fitted_tree import BRANCHLESS, FittedTree
from rendezview_ground.learn.trees.forest import ForestSamples, forest_of, joined, learn_forest
from rendezview_ground.learn.views.views import look_from

OPTIONS = TrainingOptions(forest_trees=3)
NODES = range(12)


@pytest.fixture(scope="module")
def samples() -> ForestSamples:
    """3000 outlines whose two lobes move with the direction of view."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    angle = 2.0 * np.pi * np.arange(BINS) / BINS
    lobes = direction[:, :1] * np.cos(2.0 * angle) + direction[:, 1:2] * np.sin(3.0 * angle)
    readings = np.rint(40.0 + 25.0 * lobes + 10.0 * direction[:, 2:] * np.cos(angle))
    return ForestSamples(
        0,
        np.array([look_from(node, 0.0) for node in Geodesic.of_order(0).nodes]),
        readings.astype(np.uint8),
        np.array([look_from(d, 0.0) for d in direction]).astype(np.float32),
        direction.astype(np.float32),
    )


def test_a_tree_is_taken_over_entry_by_entry():
    rng = np.random.default_rng(1)
    readings = rng.integers(0, 256, (500, 12)).astype(np.float32)
    labels = (readings[:, 3] < 120) ^ (rng.random(500) < 0.1)
    peer = DecisionTreeClassifier(min_samples_leaf=8, random_state=0).fit(readings, labels)
    tree = FittedTree.of(peer, peer.classes_)
    leaves = tree.component == BRANCHLESS
    assert (tree.on + tree.off)[leaves].sum() == 500
    assert tree.on[0] == labels.sum()
    assert np.all(tree.right[~leaves] >= 2)
    for row, leaf in zip(readings, peer.apply(readings), strict=True):
        entry = 0
        while tree.component[entry] != BRANCHLESS:
            left = row[tree.component[entry]] <= tree.threshold[entry]
            entry += 1 if left else int(tree.right[entry])
        assert entry == leaf


@pytest.mark.parametrize("label", [False, True])
def test_one_category_is_counted_as_what_it_is(label):
    peer = DecisionTreeClassifier().fit(np.zeros((5, 2)), np.full(5, label))
    tree = FittedTree.of(peer, peer.classes_)
    assert (tree.on.tolist(), tree.off.tolist()) == (([5], [0]) if label else ([0], [5]))


@pytest.mark.requirement("RV-TRAIN-3")
def test_the_runtime_asks_the_leaves_that_scikit_learn_finds(samples):
    """Readings of a frame are not whole; rounded up, they reach the same leaf of every tree."""
    tables = ForestTables.of(joined([learn_forest(samples, OPTIONS, NODES)]))
    rng = np.random.default_rng(2)
    odds = []
    for node in NODES:
        readings, labels, random = samples_of(samples, node)
        forest = forest_of(readings, labels, OPTIONS, random)
        for _ in range(40):
            frame = rng.uniform(0.0, 90.0, BINS).astype(np.float32)
            roll, seen = float(rng.uniform(-7.0, 7.0)), np.empty(BINS, dtype=np.float32)
            roll_readings(frame, roll, seen)
            wanted = []
            for tree in forest.estimators_:
                leaf = tree.apply(np.ceil(seen)[None])[0]
                counts = tree.tree_.value[leaf, 0] * tree.tree_.n_node_samples[leaf]
                off, on = np.rint(counts)
                log_odds = np.log((on + learner._PRIOR[0]) / (off + learner._PRIOR[1]))
                wanted.append(np.clip(np.rint(log_odds / ODDS_UNIT), -127, 127))
            found = np.empty(1)
            _ask_each(frame, np.array([node]), np.array([roll]), tables, found)
            assert found[0] == pytest.approx(np.mean(wanted), abs=1e-9)
            odds.append(found[0])
    assert np.std(odds) > 5.0


def samples_of(
    samples: ForestSamples, node: int
) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """What `learn_forest` learns of a node, and its random numbers after that."""
    random = learner.stream_of(OPTIONS, node)
    return *samples.of_node(node, OPTIONS, random), random


def test_samples_are_rolled_and_rounded_up():
    rng = np.random.default_rng(3)
    readings = rng.integers(20, 80, (5, BINS), dtype=np.uint8)
    rolls, rows = rng.uniform(-7.0, 7.0, 5), np.arange(5)[::-1].copy()
    strain = rng.uniform(0.9, 1.1, (5, BINS)).astype(np.float32)
    out = np.empty((5, BINS), dtype=np.uint8)
    learner._rolled_bytes(readings, rows, rolls, strain, out)
    for k, row in enumerate(rows):
        seen = np.empty(BINS, dtype=np.float32)
        roll_readings(readings[row].astype(np.float32), rolls[k], seen)
        assert np.array_equal(out[k], np.ceil(seen * strain[k]))


def test_forests_know_their_nodes_from_others(samples):
    """On samples of the same kind that were not learned, with errors of roll and shape."""
    tables = ForestTables.of(joined([learn_forest(samples, OPTIONS, NODES)]))
    right = total = 0
    for node in NODES:
        fresh = np.random.default_rng([99, node])
        readings, labels = samples.of_node(node, OPTIONS, fresh)
        odds = np.empty(1)
        for row, label in zip(readings[::10], labels[::10], strict=True):
            _ask_each(row.astype(np.float32), np.array([node]), np.zeros(1), tables, odds)
            right += (odds[0] * ODDS_UNIT > -1.0) == label
            total += 1
    assert right / total > 0.9


def test_a_forest_learned_in_parts_is_that_learned_at_once(samples):
    whole = joined([learn_forest(samples, OPTIONS, NODES)])
    parts = joined([learn_forest(samples, OPTIONS, part) for part in (range(5), range(5, 12))])
    for field in dataclasses.fields(whole):
        a, b = getattr(whole, field.name), getattr(parts, field.name)
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    whole.check(12)
    assert whole.roots.shape == (12, 3)


def test_many_samples_do_not_make_more_entries_than_can_be_counted(samples, monkeypatch):
    monkeypatch.setattr(learner, "_MOST_LEAVES", 16)
    small = learn_forest(samples, OPTIONS, NODES)
    monkeypatch.undo()
    full = learn_forest(samples, OPTIONS, NODES)
    assert np.diff(small["roots"].ravel()).max() <= 2 * 17
    assert len(full["component"]) > len(small["component"])
    assert (small["component"] == LEAF).sum() > len(small["component"]) / 2
