"""Trees as scikit-learn fits them, in the arrays of a model: depth first, with whole thresholds.

Readings are whole numbers while a tree is learned. A reading at or below the threshold goes left,
as in scikit-learn, so the next whole number below a threshold gives the same decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview_ground.learn.jobs.stages import Arrays, together

if TYPE_CHECKING:
    from sklearn.tree import BaseDecisionTree

Int64s = npt.NDArray[np.int64]
BRANCHLESS = -1  # component of a leaf. Source: by construction


class FittedTree(NamedTuple):
    """M entries, depth first: a left child follows its parent."""

    component: Int64s  # (M,) column of the readings; BRANCHLESS at a leaf
    threshold: Array  # (M,) whole; readings at or below go left. 0 at a leaf
    right: Int64s  # (M,) entries ahead of the right child; 0 at a leaf
    on: Int64s  # (M,) samples that are on
    off: Int64s  # (M,) samples that are off

    @classmethod
    def of(cls, fitted: BaseDecisionTree, categories: npt.NDArray[np.bool_]) -> FittedTree:
        """The arrays of a fitted tree.

        Args:
            fitted: on whole readings.
            categories: (1,) or (2,) of the labels, in the order of the tree's counts.
        """
        tree = fitted.tree_
        inner, entries = tree.children_left >= 0, np.arange(tree.node_count)
        # The order of scikit-learn's depth-first builder, of trees without a limit on leaves.
        assert np.array_equal(tree.children_left[inner], entries[inner] + 1)
        samples = np.zeros((tree.node_count, 2), dtype=np.int64)
        shares = tree.value[:, 0, :] * tree.weighted_n_node_samples[:, None]
        samples[:, categories.astype(np.intp)] = np.rint(shares)
        return cls(
            np.where(inner, tree.feature, BRANCHLESS).astype(np.int64),
            np.where(inner, np.floor(tree.threshold), 0.0),
            np.where(inner, tree.children_right - entries, 0),
            samples[:, 1],
            samples[:, 0],
        )


def joined_trees(parts: Sequence[Arrays], places: Sequence[str]) -> Arrays:
    """Arrays of all parts; ``places`` name those that count entries from the first of a part."""
    starts = np.cumsum([0, *(len(part["component"]) for part in parts[:-1])])
    moved = [
        part | {name: (part[name] + start).astype(np.int32) for name in places}
        for part, start in zip(parts, starts, strict=True)
    ]
    return together(moved)


def seed_of(*stream: int) -> int:
    """The state of scikit-learn's random numbers for a stream of ours."""
    return int(np.random.SeedSequence(stream).generate_state(1)[0])
