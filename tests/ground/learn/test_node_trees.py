"""Learned trees: what they decide, when they stop, and that they are scikit-learn's."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.tree import DecisionTreeClassifier

from rendezview.geometry.geodesic import Geodesic, angle_between
from rendezview.sensors.appearance.model.signature import rolled, twist
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.learn.trees.node_trees import (
    Samples,
    TreeSet,
    fitted,
    learn_trees,
    learned_tree,
)
from rendezview_ground.learn.views.views import ViewSet, look_from

PAPER = TrainingOptions(bins=24, smooth_bins=1, component_step=1, min_samples_split=2, min_gain=0.0)


def view_set(rng: np.random.Generator, directions: np.ndarray, bins: int, rolls: bool) -> ViewSet:
    count = len(directions)
    angles = rng.uniform(0.0, 6.0, count) if rolls else np.zeros(count)
    rotations = np.array([look_from(d, a) for d, a in zip(directions, angles, strict=True)])
    readings = rng.integers(200, 900, (count, bins)).astype(np.float32)
    return ViewSet(
        directions, np.ones(count), rotations, readings, np.ones(count), np.zeros((count, 2))
    )


@pytest.fixture(scope="module")
def samples() -> Samples:
    rng = np.random.default_rng(0)
    random = rng.normal(size=(300, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    lattice = view_set(rng, Geodesic.of_order(2).nodes, 24, rolls=False)
    return Samples(1, lattice, view_set(rng, random, 24, rolls=True))


def data(rng: np.random.Generator, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    readings = rng.integers(0, 40, (count, 24)).astype(np.float32)
    labels = (readings[:, 3] > 20) ^ (readings[:, 7] > 30) | (rng.random(count) < 0.05)
    return readings, labels


def decisions(trees: TreeSet, readings: np.ndarray, tree: int = 0) -> np.ndarray:
    return np.array([trees.forest.category[trees.forest.leaf(tree, r)] for r in readings]) == 1


def test_leaf_counts_are_the_samples_that_reach_each_leaf():
    readings, labels = data(np.random.default_rng(2))
    trees = learned_tree(readings, labels, dataclasses.replace(PAPER, min_samples_split=20), 0)
    leaves = np.array([trees.forest.leaf(0, r) for r in readings])
    count = len(trees.forest.component)
    assert np.array_equal(trees.leaf_on, np.bincount(leaves[labels], minlength=count))
    assert np.array_equal(trees.leaf_off, np.bincount(leaves[~labels], minlength=count))
    right = np.mean(decisions(trees, readings) == labels)
    assert 0.6 < right < 1.0
    assert trees.training_accuracy[0] == pytest.approx(right)


@pytest.mark.requirement("RV-TRAIN-3")
@pytest.mark.parametrize("step", [1, 3])
@pytest.mark.parametrize(
    ("least", "gain"), [(2, 1e-3), (30, 1e-3), (2, 0.003), (2, 0.02), (2, 0.03)]
)
def test_decisions_are_scikit_learns_and_thresholds_are_whole(step, least, gain):
    readings, labels = data(np.random.default_rng(7))
    options = dataclasses.replace(
        PAPER, component_step=step, min_samples_split=least, min_gain=gain
    )
    trees = learned_tree(readings, labels, options, 0)
    reference = DecisionTreeClassifier(
        criterion="entropy",
        min_samples_split=least,
        min_impurity_decrease=gain / np.log(2.0),
        random_state=0,
    ).fit(readings[:, ::step], labels)
    assert np.array_equal(decisions(trees, readings), reference.predict(readings[:, ::step]))
    inner = trees.forest.component >= 0
    assert np.array_equal(trees.forest.threshold, np.rint(trees.forest.threshold))
    assert (trees.forest.component[inner] % step == 0).all()
    assert inner.sum() == (reference.tree_.children_left >= 0).sum()


@pytest.mark.requirement("RV-TRAIN-3")
@pytest.mark.parametrize(("low", "high"), [(0, 40), (200, 900), (0, 6000)])
@pytest.mark.parametrize("step", [1, 4])
def test_the_runtime_decides_as_scikit_learns_predict_does(low, high, step):
    """On views that were not learned too, between two bins, and beyond the learned readings."""
    rng = np.random.default_rng(low + high + step)
    readings = rng.integers(low, high, (400, 24)).astype(np.float32)
    labels = (readings[:, 4] > np.median(readings[:, 4])) ^ (rng.random(400) < 0.1)
    options = dataclasses.replace(PAPER, component_step=step)
    forest = learned_tree(readings, labels, options, 3).forest
    classifier, levels = fitted(readings, labels, options, 3)
    fresh = rng.integers(max(low - 50, 0), high + 50, (500, 24)).astype(np.float32)
    rolls = rng.uniform(-7.0, 7.0, 500)
    seen = np.array([rolled(row, roll) for row, roll in zip(fresh, rolls, strict=True)])
    theirs = classifier.predict(levels.levels(seen[:, ::step]))
    tree = np.zeros(1, dtype=np.intp)
    ours = [
        forest.category[forest.leaves(row, tree, np.array([roll]))[0]]
        for row, roll in zip(fresh, rolls, strict=True)
    ]
    assert np.array_equal(np.array(ours) == 1, theirs)
    assert 50 < theirs.sum() < 450


def test_a_seed_and_a_node_decide_between_equal_splits():
    rng = np.random.default_rng(11)
    column = rng.integers(0, 40, (200, 1))
    readings = np.repeat(column, 24, axis=1).astype(np.float32)  # every bin tells the same
    labels = column[:, 0] > 20

    def bin_of(seed: int, node: int) -> int:
        options = dataclasses.replace(PAPER, seed=seed)
        return int(learned_tree(readings, labels, options, node).forest.component[0])

    assert [bin_of(0, n) for n in range(9)] == [bin_of(0, n) for n in range(9)]
    assert len({bin_of(0, n) for n in range(9)}) > 3
    assert len({bin_of(s, 0) for s in range(9)}) > 3


def test_labels_of_the_lattice_are_in_and_out(samples):
    only = Samples(1, samples.lattice, None)
    for node, counts in ((0, (16, 45)), (20, (19, 54))):
        readings, labels = only.of_node(node, PAPER)
        assert (labels.sum(), (~labels).sum()) == counts
        assert len(readings) == sum(counts)


def test_labels_of_perturbed_views_follow_their_distance(samples):
    options = dataclasses.replace(PAPER, far_fraction=0.0, label_edges=1.1, reach_edges=2.0)
    node = 5
    readings, labels = samples.of_node(node, options)
    edges = (
        angle_between(samples.perturbed.direction, Geodesic.of_order(1).nodes[node])
        / Geodesic.of_order(1).mean_edge_rad
    )
    near = edges[edges <= 2.0]
    assert len(readings) - 61 == len(near) > 20  # a five-valent node: 16 + 45 of the lattice
    assert np.array_equal(labels[61:], near <= 1.1)


def test_far_views_are_a_share_and_all_off(samples):
    none, some, every = (
        samples.of_node(
            20, dataclasses.replace(PAPER, reach_edges=1.2, far_edges=3.0, far_fraction=f)
        )[1]
        for f in (0.0, 0.4, 1.0)
    )
    assert len(none) < len(some) < len(every)
    assert none.sum() == some.sum() == every.sum()
    assert (len(some) - len(none)) / (len(every) - len(none)) == pytest.approx(0.4, abs=0.12)


def test_samples_are_rolled_as_the_nodes_own_camera_would_have_them(samples):
    options = dataclasses.replace(PAPER, roll_error_rad=0.0, far_fraction=0.0, reach_edges=1.2)
    node = 20
    readings, _ = samples.of_node(node, options)
    assert np.any(np.all(readings[:73] == samples.lattice.readings[node], axis=1))
    edge = Geodesic.of_order(1).mean_edge_rad
    away = angle_between(samples.perturbed.direction, Geodesic.of_order(1).nodes[node])
    for row, k in zip(readings[73:], np.flatnonzero(away <= 1.2 * edge), strict=True):
        roll = twist(
            samples.perturbed.centred_from_target[k], samples.lattice.centred_from_target[node]
        )
        assert np.array_equal(row, rolled(samples.perturbed.readings[k], float(roll)))


def test_trees_learned_in_parts_are_those_learned_at_once(samples):
    whole = learn_trees(samples, PAPER, range(10))
    parts = TreeSet.joined([learn_trees(samples, PAPER, range(k, k + 5)).arrays() for k in (0, 5)])
    for f in dataclasses.fields(whole.forest):
        a, b = getattr(whole.forest, f.name), getattr(parts.forest, f.name)
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    assert np.array_equal(whole.leaf_on, parts.leaf_on)


def test_a_tree_answers_its_own_samples_through_the_compiled_path(samples):
    only = Samples(1, samples.lattice, None)
    trees = learn_trees(only, PAPER, range(42))
    rng = np.random.default_rng(8)
    for node in rng.integers(0, 42, 6):
        _, labels = only.of_node(node, PAPER)
        view = samples.lattice
        spin = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix()  # about the boresight
        assert twist(spin @ view.centred_from_target[node], view.centred_from_target[node]) == (
            pytest.approx(1.0)
        )
        entry = trees.forest.leaves(view.readings[node], np.array([node]), np.zeros(1))
        assert trees.forest.category[entry[0]] == 1
        assert labels.any()
    assert trees.training_accuracy.min() == 1.0
