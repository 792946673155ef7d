"""Decision trees: the paper's Table I and its listings, eq. 5, and the compiled evaluation."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.tree import DecisionTreeClassifier
from tests.plain_entropy import split_entropy

from rendezview.sensors.appearance.model.signature import rolled
from rendezview.sensors.appearance.model.trees import Forest

# Cleghorn & Sternberg 1991, Table I; category 1 is the left one
TABLE_I = np.array(
    [[0.6, 1.0, 1.0], [0.4, 1.0, 0.8], [0.6, 1.0, 0.8], [0.6, 1.2, 0.8], [0.6, 4.4, 0.8]],
    dtype=np.float32,
)
CATEGORY = np.array([2, 1, 2, 1, 2])


def forest_of(entries: list[tuple], roots: tuple[int, ...] = (0,)) -> Forest:
    """Entries are (component, threshold, left, right) or a category."""
    rows = [(-1, 0.0, 0, 0, e[0]) if len(e) == 1 else (*e, 0) for e in entries]
    component, threshold, left, right, category = zip(*rows, strict=True)
    return Forest(
        np.array(roots, dtype=np.int32),
        np.array(component, dtype=np.int16),
        np.array(threshold, dtype=np.float32),
        np.array(left, dtype=np.int32),
        np.array(right, dtype=np.int32),
        np.array(category, dtype=np.uint8),
    )


@pytest.fixture
def listed() -> Forest:
    """The listing beside Table I; components count from 0."""
    return forest_of(
        [
            (1, 1.1, 1, 6),
            (2, 0.9, 2, 5),
            (0, 0.5, 3, 4),
            (1,),
            (2,),
            (2,),
            (1, 2.3, 7, 8),
            (1,),
            (2,),
        ]
    )


def random_forest(rng: np.random.Generator, bins: int, trees: int, depth: int) -> Forest:
    entries: list[tuple] = []
    roots = []

    def grow(level: int) -> int:
        place = len(entries)
        if level == 0 or rng.random() < 0.15:
            entries.append((int(rng.integers(2)),))
            return place
        entries.append(())
        bin_, threshold = int(rng.integers(bins)), float(rng.integers(200, 800))
        left = grow(level - 1)
        entries[place] = (bin_, threshold, left, grow(level - 1))
        return place

    for _ in range(trees):
        roots.append(len(entries))
        grow(depth)
    return forest_of(entries, tuple(roots))


def test_the_tree_of_table_1_assigns_the_categories_of_table_1(listed):
    found = [int(listed.category[listed.leaf(0, sample)]) for sample in TABLE_I]
    assert found == CATEGORY.tolist()
    assert [listed.leaf(0, sample) for sample in TABLE_I] == [5, 3, 4, 7, 8]


def test_a_reading_at_the_threshold_goes_left():
    tree = forest_of([(0, 455.0, 1, 2), (1,), (0,)])
    assert [tree.leaf(0, [r]) for r in (454, 455, 456)] == [1, 1, 2]
    on = tree.leaves(np.full(8, 455, np.float32), np.zeros(1, np.intp), np.zeros(1))
    assert on.tolist() == [1]


def test_a_tree_prints_as_in_figure_5(listed):
    assert listed.listing(0).splitlines() == [
        "0 #1 <= 1.1",
        "1 #2 <= 0.9",
        "2 #0 <= 0.5",
        "T 1",
        "T 2",
        "T 2",
        "1 #1 <= 2.3",
        "T 1",
        "T 2",
    ]
    deep = forest_of([(3, 7.0, 1, 2), (0,), (9, 8.0, 3, 6), (156, 455.0, 4, 5), (1,), (0,), (0,)])
    assert deep.listing(0).splitlines()[3] == "2 #156 <= 455"


def test_a_tree_prints_as_the_papers_if_then_else(listed):
    text = listed.rules(0, "r{}").splitlines()
    assert text == [
        "IF (r1 <= 1.1) {",
        "    IF (r2 <= 0.9) {",
        "        IF (r0 <= 0.5) {",
        "            ASSIGN Category = 1",
        "        } ELSE {",
        "            ASSIGN Category = 2",
        "        }",
        "    } ELSE {",
        "        ASSIGN Category = 2",
        "    }",
        "} ELSE {",
        "    IF (r1 <= 2.3) {",
        "        ASSIGN Category = 1",
        "    } ELSE {",
        "        ASSIGN Category = 2",
        "    }",
        "}",
    ]


def test_depth_and_leaves_are_counted(listed):
    assert (listed.depth(0), listed.leaf_count(0), listed.feature_count(0)) == (3, 5, 3)
    assert (forest_of([(1,)]).depth(0), forest_of([(1,)]).leaf_count(0)) == (0, 1)


def test_thresholds_print_whole_up_to_a_million():
    tree = forest_of([(0, 123456.0, 1, 2), (1,), (0,)])
    assert tree.listing(0).splitlines()[0] == "0 #0 <= 123456"


def test_split_entropy_is_the_number_of_samples_times_scikit_learns_gain():
    rng = np.random.default_rng(0)
    for _ in range(10):
        readings = rng.integers(0, 9, size=(60, 3)).astype(np.float32)
        labels = rng.integers(0, 3, size=60)
        stump = DecisionTreeClassifier(criterion="entropy", max_depth=1, random_state=0)
        tree = stump.fit(readings, labels).tree_
        left = readings[:, tree.feature[0]] <= tree.threshold[0]
        counts = [np.bincount(labels[side], minlength=3) for side in (left, ~left)]
        children = (tree.weighted_n_node_samples * tree.impurity)[1:].sum()
        gain_bits = 60 * tree.impurity[0] - children
        assert split_entropy(*counts) == pytest.approx(gain_bits * np.log(2.0), abs=1e-9)


@pytest.mark.parametrize("bins", [360, 294, 8])
def test_compiled_evaluation_is_rolling_and_walking_exactly(bins):
    rng = np.random.default_rng(bins)
    forest = random_forest(rng, bins, 30, 7)
    for k in range(60):
        readings = rng.integers(150, 850, bins).astype(np.float32)
        trees = rng.integers(0, len(forest), 40)
        rolls = rng.uniform(-7.0, 7.0, 40)
        if k % 3 == 0:  # whole and half bins, where rounding decides
            rolls = rng.integers(-bins, bins, 40) * (np.pi / bins)
        found = forest.leaves(readings, trees, rolls)
        expected = [forest.leaf(t, rolled(readings, r)) for t, r in zip(trees, rolls, strict=True)]
        assert found.tolist() == expected


def rolled_in_numpy(readings: np.ndarray, roll: float) -> np.ndarray:
    bins = len(readings)
    shift = -roll * bins / (2.0 * np.pi)
    whole = int(np.floor(shift))
    part = np.float32(shift - whole)
    first = np.roll(readings, -whole)
    second = np.roll(readings, -whole - 1)
    return np.rint((np.float32(1.0) - part) * first + part * second)


def test_compiled_rolling_is_the_plain_one_exactly():
    rng = np.random.default_rng(9)
    for bins in (360, 294, 7):
        for roll in [*rng.uniform(-10.0, 10.0, 50), 0.0, np.pi, -np.pi, 2 * np.pi / bins]:
            readings = rng.integers(0, 3000, bins).astype(np.float32)
            assert np.array_equal(rolled(readings, roll), rolled_in_numpy(readings, roll))


@pytest.mark.parametrize(
    "entries",
    [
        [(0, 1.0, 0, 1), (1,)],  # its own child
        [(0, 1.0, 1, 2), (1, 1.0, 0, 2), (1,)],  # a child before its parent
        [(0, 1.0, 1, 5), (1,), (0,)],  # a child outside
        [(0, 1.0, -1, 1), (1,)],
    ],
)
def test_a_forest_that_could_loop_or_leave_its_arrays_is_refused(entries):
    with pytest.raises(ValueError, match="child"):
        forest_of(entries)


@pytest.mark.parametrize("root", [-1, 3])
def test_a_root_outside_the_forest_is_refused(root):
    with pytest.raises(ValueError, match="root"):
        forest_of([(0, 1.0, 1, 2), (1,), (0,)], (root,))


def test_arrays_of_different_lengths_are_refused(listed):
    parts = [listed.component, listed.threshold, listed.left, listed.right, listed.category]
    for k in range(len(parts)):
        cut = [p[:-1] if i == k else p for i, p in enumerate(parts)]
        with pytest.raises(ValueError, match="length"):
            Forest(listed.roots, *cut)
