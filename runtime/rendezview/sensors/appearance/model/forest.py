"""The forest: a few small trees for each node, whose mean says how likely a view is the node's.

The tree of a node (`trees`) decides yes or no, and can be read by people. Its forest reads the
same outline in 90 bins. Each has learned other samples and other bins, whole silhouettes and
silhouettes of sunlit parts, so their mean is a graded answer that holds in hard light too
(L. Breiman, Random forests, Machine Learning 45, 2001). The votes order the work of a first pose,
and they are evidence beside the edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.shadowed_silhouettes import READING_UNIT, SHADOWED_BINS
from rendezview.sensors.appearance.model.signature import (
    Readings,
    Signature,
    rebinning,
    roll_against,
    roll_readings,
)

Bytes = npt.NDArray[np.uint8]

BINS = SHADOWED_BINS
LEAF = 255  # as a bin. Source: by construction, format of the model file
ODDS_UNIT = 1.0 / 16.0  # of a leaf's log odds. Source: by construction, format of the model file
INSIDE_EDGES = 1.0  # nodes that should be active. Source: by construction, the paper's figure 3


@dataclass(frozen=True, slots=True, eq=False)
class ScoreForest:
    """Small trees in flat arrays of M entries; the left child follows its parent."""

    roots: npt.NDArray[np.int32]  # (nodes, T) entry at which each tree starts
    component: Bytes  # (M,) bin looked at; LEAF at a leaf
    threshold: Bytes  # (M,) in READING_UNIT: left where the reading is at or below; of a leaf: 0
    right: npt.NDArray[np.uint16]  # (M,) entries ahead, of the right child; 0 at a leaf
    odds: npt.NDArray[np.int8]  # (M,) of a leaf: log odds that the view is the node's, ODDS_UNIT

    def check(self, nodes: int) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        entries = len(self.component)
        for name in ("threshold", "right", "odds"):
            if getattr(self, name).shape != (entries,):
                raise ValueError(f"voters.{name} has another length than voters.component")
        if self.roots.ndim != 2 or len(self.roots) != nodes or self.roots.shape[1] == 0:
            raise ValueError(f"voters.roots has shape {self.roots.shape} for {nodes} nodes")
        if int(self.roots.min()) < 0 or int(self.roots.max()) >= entries:
            raise ValueError("a root of the forest lies outside them")
        inner = self.component != LEAF
        if np.any(self.component[inner] >= BINS):
            raise ValueError("a tree of the forest looks at a bin beyond the signature")
        ahead = np.arange(entries) + self.right
        if np.any(inner & ((self.right < 2) | (ahead >= entries))):
            raise ValueError("a child in the forest must come after its parent's left one")


class ForestTables(NamedTuple):
    """``ScoreForest`` for the compiled loops: all of an entry in one word, one line of memory."""

    roots: npt.NDArray[np.int32]  # (nodes, T)
    # (M,) component, then threshold, or the odds of a leaf, then right: 8, 8 and 16 bits
    entries: npt.NDArray[np.uint32]

    @classmethod
    def of(cls, forest: ScoreForest) -> ForestTables:
        """The tables of the forest."""
        leaf = forest.component == LEAF
        middle = np.where(leaf, forest.odds.view(np.uint8), forest.threshold)
        entries = forest.component.astype(np.uint32)
        entries |= middle.astype(np.uint32) << 8
        entries |= forest.right.astype(np.uint32) << 16
        # Arrays of a file cannot be written to, which would be another type to the compiler.
        return cls(forest.roots.copy(), entries)


class ForestScores:
    """The forest of one model beside one signature: a score for any attitude."""

    def __init__(
        self, forest: ScoreForest, nodes: Array, rotations: Array, edge_rad: float
    ) -> None:
        """Tables of a model.

        Args:
            forest: of the nodes.
            nodes: (N, 3) their directions.
            rotations: (N, 3, 3) centred_from_target of their views.
            edge_rad: mean angle between neighbouring nodes.
        """
        self._tables = ForestTables.of(forest)
        self._nodes = np.ascontiguousarray(nodes)
        self._rotations = np.ascontiguousarray(rotations)
        self._cosine = float(np.cos(INSIDE_EDGES * edge_rad))

    def scores(self, signature: Signature, rotations: Array) -> Array:
        """(K,) mean log odds of the nodes within one edge of each pose.

        Args:
            signature: of the frame.
            rotations: (K, 3, 3) camera_from_target.
        """
        attitudes = signature.centred_from_camera @ rotations
        out = np.empty(len(attitudes))
        _score(
            _coarse(signature.readings), np.ascontiguousarray(attitudes), self._nodes,
            self._rotations, self._cosine, self._tables, out,
        )  # fmt: skip
        return out * ODDS_UNIT

    def node_odds(self, readings: Readings, nodes: npt.NDArray[np.intp], rolls_rad: Array) -> Array:
        """(K,) mean log odds of single nodes, each with the view's own roll against it.

        Args:
            readings: (N,) of a signature.
            nodes: (K,) which.
            rolls_rad: (K,) of ``twist``.
        """
        out = np.empty(len(nodes))
        _ask_each(_coarse(readings), nodes, rolls_rad, self._tables, out)
        return out * ODDS_UNIT


def _coarse(readings: Readings) -> Readings:
    """(N,) readings in the bins and units of the forest."""
    coarse = readings @ rebinning(len(readings), BINS)
    coarse = np.minimum(coarse / np.float32(READING_UNIT), np.float32(255.0))
    return np.ascontiguousarray(coarse, dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _score(
    readings: Readings, attitudes: Array, nodes: Array, rotations: Array, cosine: float,
    forest: ForestTables, out: Array,
) -> None:  # fmt: skip
    """Fill (K,) with the mean odds, in units, of the nodes about each attitude."""
    rolled = np.empty(len(readings), dtype=np.float32)
    for k in range(len(attitudes)):
        a = attitudes[k]
        total, count = 0.0, 0
        for n in range(len(nodes)):
            near = -(a[2, 0] * nodes[n, 0] + a[2, 1] * nodes[n, 1] + a[2, 2] * nodes[n, 2])
            if near < cosine:
                continue
            roll_readings(readings, roll_against(a, rotations[n]), rolled)
            total += _ask(rolled, n, forest)
            count += 1
        out[k] = total / count if count > 0 else -127.0


@njit(cache=True, nogil=True, error_model="numpy")
def _ask_each(
    readings: Readings, nodes: npt.NDArray[np.intp], rolls_rad: Array, forest: ForestTables,
    out: Array,
) -> None:  # fmt: skip
    """Fill (K,) with the mean odds, in units, of each node at its roll."""
    rolled = np.empty(len(readings), dtype=np.float32)
    for k in range(len(nodes)):
        roll_readings(readings, rolls_rad[k], rolled)
        out[k] = _ask(rolled, nodes[k], forest)


@njit(cache=True, nogil=True, error_model="numpy")
def _ask(rolled: Readings, node: int, forest: ForestTables) -> float:
    """Mean odds, in units, that the forest of a node gives to readings at its roll."""
    trees = forest.roots.shape[1]
    total = 0.0
    for t in range(trees):
        at = np.int64(forest.roots[node, t])
        entry = np.int64(forest.entries[at])
        while entry & 255 != LEAF:
            goes_left = rolled[entry & 255] <= entry >> 8 & 255
            at += 1 if goes_left else entry >> 16
            entry = np.int64(forest.entries[at])
        odds = entry >> 8 & 255
        total += odds - 256 if odds > 127 else odds
    return total / trees  # type: ignore[no-any-return]
