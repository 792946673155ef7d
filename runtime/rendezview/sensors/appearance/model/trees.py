"""Decision trees over signature readings: evaluation and listings.

A forest holds one tree per node of the geodesic sphere in flat arrays, children after
their parent. A reading at or below the threshold goes left (Cleghorn & Sternberg,
figure 4).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.signature import Readings


@dataclass(frozen=True, slots=True, eq=False)
class Forest:
    """Binary decision trees in flat arrays of M branch and leaf entries."""

    roots: npt.NDArray[np.int32]  # (T,) entry at which each tree starts
    component: npt.NDArray[np.int16]  # (M,) bin looked at; −1 at a leaf
    threshold: npt.NDArray[np.float32]  # (M,) go left where reading <= threshold
    left: npt.NDArray[np.int32]  # (M,)
    right: npt.NDArray[np.int32]  # (M,)
    category: npt.NDArray[np.uint8]  # (M,) at a leaf: 1 = view recognised (on), 0 = off

    def __post_init__(self) -> None:
        entries = len(self.component)
        if any(len(a) != entries for a in (self.threshold, self.left, self.right, self.category)):
            raise ValueError("the arrays of a forest must have one length")
        inner = self.component >= 0
        index = np.arange(entries)
        for child in (self.left, self.right):
            if np.any(inner & ((child <= index) | (child >= entries))):
                raise ValueError("a child of a tree must come after its parent")
        if len(self.roots) and (self.roots.min() < 0 or self.roots.max() >= entries):
            raise ValueError("a root lies outside the forest")

    def __len__(self) -> int:
        return len(self.roots)

    def leaf(self, tree: int, readings: npt.ArrayLike) -> int:
        """Entry of the leaf that a signature (N,) ends in."""
        values = np.asarray(readings)
        entry = int(self.roots[tree])
        while self.component[entry] >= 0:
            goes_left = values[self.component[entry]] <= self.threshold[entry]
            entry = int(self.left[entry] if goes_left else self.right[entry])
        return entry

    def leaves(
        self,
        readings: Readings,
        trees: npt.NDArray[np.intp],
        rolls_rad: Array,
    ) -> npt.NDArray[np.int32]:
        """Leaf of each of K trees for one signature, each tree with its own roll.

        Args:
            readings: (N,) signature of the view.
            trees: (K,) which trees to ask.
            rolls_rad: (K,) roll of the view against each tree's node; see ``twist``.
        """
        out = np.empty(len(trees), dtype=np.int32)
        _leaves(
            self.roots,
            self.component,
            self.threshold,
            self.left,
            self.right,
            readings,
            trees,
            rolls_rad,
            out,
        )
        return out

    def entries(self, tree: int) -> Iterator[tuple[int, int]]:
        """(entry, level) of one tree in depth-first order, left before right; root is level 0."""
        stack = [(int(self.roots[tree]), 0)]
        while stack:
            entry, level = stack.pop()
            yield entry, level
            if self.component[entry] >= 0:
                stack.append((int(self.right[entry]), level + 1))
                stack.append((int(self.left[entry]), level + 1))

    def depth(self, tree: int) -> int:
        """Levels below the root."""
        return max(level for _, level in self.entries(tree))

    def leaf_count(self, tree: int) -> int:
        """Terminal nodes of one tree."""
        return sum(1 for entry, _ in self.entries(tree) if self.component[entry] < 0)

    def feature_count(self, tree: int) -> int:
        """Different bins that one tree looks at: the paper's characteristic features of a node."""
        components = (int(self.component[entry]) for entry, _ in self.entries(tree))
        return len({component for component in components if component >= 0})

    def listing(self, tree: int) -> str:
        """One tree as in figure 5: ``2 #156 <= 455`` is level, bin, threshold; ``T 1`` a leaf."""
        lines = []
        for entry, level in self.entries(tree):
            if self.component[entry] < 0:
                lines.append(f"T {self.category[entry]}")
            else:
                lines.append(
                    f"{level} #{self.component[entry]} <= {_number(self.threshold[entry])}"
                )
        return "\n".join(lines)

    def rules(self, tree: int, name: str = "#{}") -> str:
        """One tree as the paper's if-then-else listing; ``name`` makes a bin's name."""
        lines: list[str] = []

        def write(entry: int, indent: str) -> None:
            if self.component[entry] < 0:
                lines.append(f"{indent}ASSIGN Category = {self.category[entry]}")
                return
            what = name.format(self.component[entry])
            lines.append(f"{indent}IF ({what} <= {_number(self.threshold[entry])}) {{")
            write(int(self.left[entry]), indent + "    ")
            lines.append(f"{indent}}} ELSE {{")
            write(int(self.right[entry]), indent + "    ")
            lines.append(f"{indent}}}")

        write(int(self.roots[tree]), "")
        return "\n".join(lines)


def _number(value: float) -> str:
    return f"{float(value):.6g}"


@njit(cache=True, nogil=True, error_model="numpy")
def _leaves(
    roots: npt.NDArray[np.int32],
    component: npt.NDArray[np.int16],
    threshold: npt.NDArray[np.float32],
    left: npt.NDArray[np.int32],
    right: npt.NDArray[np.int32],
    readings: Readings,
    trees: npt.NDArray[np.intp],
    rolls_rad: Array,
    out: npt.NDArray[np.int32],
) -> None:
    bins = readings.shape[0]
    for t in range(trees.shape[0]):
        shift = -rolls_rad[t] * bins / (2.0 * np.pi)  # rounded as in `rolled`
        whole = int(np.floor(shift))
        part = np.float32(shift - whole)
        rest = np.float32(1.0) - part
        start = whole % bins
        entry = roots[trees[t]]
        c = component[entry]
        while c >= 0:
            j = c + start
            if j >= bins:
                j -= bins
            k = j + 1 if j + 1 < bins else 0
            # the same whole reading that `rolled` gives
            reading = np.rint(rest * readings[j] + part * readings[k])
            entry = left[entry] if reading <= threshold[entry] else right[entry]
            c = component[entry]
        out[t] = entry
