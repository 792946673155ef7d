"""Trees packed for flight: six bytes per branch, leaves inside the references to them.

The branches of a tree are stored in depth-first order, left before right, so a child is a few
entries ahead of its parent. A child is one small number: 0 a leaf that means off; up to
``longest_step`` a branch so many entries ahead; above, one of the tree's leaves that mean on,
counted from its left. The forest, with which the runtime decides, stays as the model stores it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.forest import BINS, LEAF, ForestTables
from rendezview.sensors.appearance.model.signature import rebinning
from rendezview.sensors.appearance.model.trees import Forest
from rendezview.sensors.appearance.outline.votes import Matcher

MOST_16_BIT = 65535  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class PackedForest:
    """T trees with B branches and L leaves for on."""

    roots: npt.NDArray[np.uint32]  # (T,) first branch of each tree
    bins: npt.NDArray[np.uint16]  # (B,) reading to compare
    thresholds: npt.NDArray[np.uint16]  # (B,) go left if reading <= threshold
    children: npt.NDArray[np.uint16]  # (B, 2) left, right
    longest_step: int  # greatest distance from a branch to its child
    depths: npt.NDArray[np.int64]  # (T,) branches on the longest path to a leaf
    first_on: npt.NDArray[np.uint32]  # (T,) where each tree's leaves begin in on_leaves
    on_leaves: npt.NDArray[np.uint16]  # (L,) index of a leaf's trust
    trusts: Array  # (K,) probability of on at such a leaf, ascending


def pack_forest(model: ViewModel) -> PackedForest:
    """The trees of a model, packed for flight code.

    A tree that is one leaf becomes a branch with that leaf on both sides.

    Raises:
        RendezviewError: a threshold does not fit 16 bits, or a tree has too many leaves.
    """
    forest = model.forest
    trust_of = Matcher(model).trust_of(np.arange(len(forest.component), dtype=np.int32))
    trusts = np.unique(trust_of[(forest.component < 0) & (trust_of > 0.0)])
    rows: list[tuple[int, int]] = []  # bin, threshold
    on_leaves: list[int] = []
    roots, children, first_on, depths = [], [], [], []
    for tree in range(len(forest)):
        entries = list(forest.entries(tree))
        branches = [e for e, _ in entries if forest.component[e] >= 0]
        place = {entry: k for k, entry in enumerate(branches)}
        leaves = [e for e, _ in entries if forest.component[e] < 0 and trust_of[e] > 0.0]
        number = {entry: k for k, entry in enumerate(leaves)}
        roots.append(len(rows))
        first_on.append(len(on_leaves))
        on_leaves += np.searchsorted(trusts, trust_of[leaves]).tolist()
        depths.append(max(level for _, level in entries))
        for k, entry in enumerate(branches):
            rows.append((int(forest.component[entry]), _whole(forest, entry)))
            ends = (int(forest.left[entry]), int(forest.right[entry]))
            # (step, number of the leaf): one of them, (0, −1) for off
            children.append([(place.get(e, k) - k, number.get(e, -1)) for e in ends])
        if not branches:
            rows.append((0, 0))
            children.append([(0, number.get(entries[0][0], -1))] * 2)
            depths[-1] = 1
    coded = np.array(children, dtype=np.int64)  # (B, 2, 2)
    longest = int(coded[..., 0].max(initial=1))
    codes = np.where(coded[..., 1] >= 0, 1 + longest + coded[..., 1], coded[..., 0])
    if codes.max(initial=0) > MOST_16_BIT or len(trusts) > MOST_16_BIT:
        raise RendezviewError(
            "a tree of this model has too many leaves for flight code: train it with fewer views"
        )
    bins, thresholds = np.array(rows, dtype=np.uint16).T
    return PackedForest(
        np.array(roots, dtype=np.uint32),
        bins,
        thresholds,
        codes.astype(np.uint16),
        longest,
        np.array(depths, dtype=np.int64),
        np.array(first_on, dtype=np.uint32),
        np.array(on_leaves, dtype=np.uint16),
        trusts,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PackedScoreForest:
    """The trees that score attitudes: N nodes with T each, C bins of W readings."""

    roots: npt.NDArray[np.int32]  # (N, T) entry at which each tree starts
    entries: npt.NDArray[np.uint32]  # (M,) bin, threshold or odds, right child: 8, 8, 16 bits
    depth: int  # branches on the longest path to a leaf
    starts: npt.NDArray[np.int64]  # (C,) first reading of each bin
    windows: npt.NDArray[np.float32]  # (C, W) weights of the readings from there


def pack_score_forest(model: ViewModel) -> PackedScoreForest | None:
    """The trees of a model that score attitudes; None where it has none."""
    if model.score_forest is None:
        return None
    tables = ForestTables.of(model.score_forest)
    at, depth = tables.roots.ravel().astype(np.int64), -1
    while len(at):
        at = at[tables.entries[at] & 255 != LEAF]
        at = np.concatenate([at + 1, at + (tables.entries[at] >> 16)])
        depth += 1
    return PackedScoreForest(tables.roots, tables.entries, depth, *windows_of(model.bins))


def windows_of(bins: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """The first reading (C,) of each bin of the forest, and the weights (C, W) from there on."""
    weights = rebinning(bins, BINS)
    centres = np.rint(np.arange(BINS) * bins / BINS).astype(np.int64)
    reading, window = np.nonzero(weights)
    apart = (reading - centres[window] + bins // 2) % bins - bins // 2
    starts = (centres + apart.min()) % bins
    columns = (starts[:, None] + np.arange(np.ptp(apart) + 1)) % bins
    return starts, weights[columns, np.arange(BINS)[:, None]]


def _whole(forest: Forest, entry: int) -> int:
    """A threshold as a whole number: readings are whole, so the fraction never decides."""
    threshold = float(np.floor(forest.threshold[entry]))
    if not 0.0 <= threshold <= MOST_16_BIT:
        raise RendezviewError(
            f"a threshold of this model, {threshold:g}, does not fit the 16 bits it has in "
            f"flight code: train the model again"
        )
    return int(threshold)
