"""Notes about the topology of a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendezview_ground.mesh.triangles import Edges


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
    edges = Edges.of(faces)
    still_open, mixed = len(edges.open_edges), len(edges.mixed_edges)
    notes = []
    if still_open:
        notes.append(f"Not watertight: {counted(still_open, 'open edge')}; fine for rendering.")
    if mixed:
        notes.append(
            f"Mixed winding: the faces on both sides of {counted(mixed, 'edge')} "
            "face opposite ways; fine for rendering."
        )
    return tuple(notes)
