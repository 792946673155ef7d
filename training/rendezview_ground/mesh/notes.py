"""Notes about the topology of a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def counted(count: int, noun: str) -> str:
    """``1 face``, ``2 faces``, ``3 bodies``."""
    if count == 1:
        return f"1 {noun}"
    if noun.endswith("y"):
        return f"{count} {noun[:-1]}ies"
    if noun.endswith("x"):
        return f"{count} {noun[:-2]}ices"
    return f"{count} {noun}s"


def topology_notes(faces: NDArray[np.int64]) -> tuple[str, ...]:
    """Notes on open edges and mixed winding. Both are fine for rendering.

    Args:
        faces: (F, 3) vertices, equal positions merged.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    ordered = edges[:, 0] < edges[:, 1]
    low, high = edges.min(axis=1), edges.max(axis=1)
    key, edge, count = np.unique(
        low * (int(faces.max()) + 1) + high, return_inverse=True, return_counts=True
    )
    forward = np.bincount(edge.reshape(-1), weights=ordered, minlength=len(key))
    open_edges = int((count == 1).sum())
    mixed = int(((count == 2) & (forward != 1)).sum())
    notes = []
    if open_edges:
        notes.append(f"Not watertight: {counted(open_edges, 'open edge')}; fine for rendering.")
    if mixed:
        notes.append(
            f"Mixed winding: the faces on both sides of {counted(mixed, 'edge')} "
            "face opposite ways; fine for rendering."
        )
    return tuple(notes)
