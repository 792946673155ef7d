"""A model with a forest of random trees: every offset, threshold and sign occurs in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.forest import BINS, LEAF, ScoreForest

Entry = tuple[int, int, int, int]  # bin, threshold, right child, odds
TREES = 7  # a mean of so many is rounded


def random_tree(rng: np.random.Generator, depth: int) -> list[Entry]:
    """A tree of at most so many levels; thresholds lie among the readings, a few beyond them."""
    if depth == 0 or rng.uniform() < 0.15:
        return [(LEAF, 0, 0, int(rng.integers(-128, 128)))]
    left, right = random_tree(rng, depth - 1), random_tree(rng, depth - 1)
    threshold = rng.integers(0, 256) if rng.uniform() < 0.1 else rng.integers(20, 70)
    return [(int(rng.integers(BINS)), int(threshold), 1 + len(left), 0), *left, *right]


@pytest.fixture(scope="session")
def forest_model(tiny_model: ViewModel) -> ViewModel:
    rng = np.random.default_rng(9)
    trees = [random_tree(rng, k % 8) for k in range(TREES * len(tiny_model.forest))]
    component, threshold, right, odds = np.array([entry for tree in trees for entry in tree]).T
    roots = np.cumsum([0, *map(len, trees[:-1])]).reshape(-1, TREES)
    forest = ScoreForest(
        roots.astype(np.int32), component.astype(np.uint8), threshold.astype(np.uint8),
        right.astype(np.uint16), odds.astype(np.int8),
    )  # fmt: skip
    forest.check(len(roots))
    return replace(tiny_model, score_forest=forest)
