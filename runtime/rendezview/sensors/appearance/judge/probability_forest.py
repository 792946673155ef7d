"""A forest of decision trees that gives a probability (Breiman 2001), as arrays in a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array


@dataclass(frozen=True, slots=True, eq=False)
class ProbabilityForest:
    """Trees one after the other: a node sends features up to its threshold left, others right."""

    root: npt.NDArray[np.int32]  # (T,) first node of each tree
    feature: npt.NDArray[np.int8]  # (N,) that a node asks for; −1: it is a leaf
    threshold: npt.NDArray[np.float32]  # (N,)
    left: npt.NDArray[np.int32]  # (N,) node
    right: npt.NDArray[np.int32]  # (N,) node
    share: npt.NDArray[np.float32]  # (N,) of the samples in a node for which the answer is yes

    def probability(self, features: Array) -> float:
        """The mean over all trees of the share in the leaf that the features (F,) reach."""
        node = self.root
        asked = np.asarray(features, dtype=np.float32)
        while True:
            feature = self.feature[node]
            inner = feature >= 0
            if not inner.any():
                return float(self.share[node].mean())
            below = asked[feature] <= self.threshold[node]
            node = np.where(inner, np.where(below, self.left[node], self.right[node]), node)

    @classmethod
    def of(cls, trees: list[Any]) -> ProbabilityForest:
        """From scikit-learn's trees of two classes, each a fitted classifier's ``tree_``."""
        sizes = [tree.node_count for tree in trees]
        root = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)
        leaf = np.concatenate([tree.children_left < 0 for tree in trees])
        values = np.concatenate([tree.value[:, 0, :] for tree in trees])

        def joined(name: str) -> npt.NDArray[Any]:
            return np.concatenate([getattr(tree, name) for tree in trees])

        def shifted(name: str) -> npt.NDArray[np.int32]:
            moved = [getattr(t, name) + start for t, start in zip(trees, root, strict=True)]
            return np.where(leaf, 0, np.concatenate(moved)).astype(np.int32)

        # scikit-learn compares features of 32 bits with thresholds of 64: round those down.
        exact = joined("threshold")
        threshold = exact.astype(np.float32)
        above = threshold > exact
        threshold[above] = np.nextafter(threshold[above], np.float32(-np.inf))
        return cls(
            root,
            np.where(leaf, -1, joined("feature")).astype(np.int8),
            np.where(leaf, 0.0, threshold).astype(np.float32),
            shifted("children_left"),
            shifted("children_right"),
            (values[:, 1] / values.sum(1)).astype(np.float32),
        )
