"""In-views and out-views of a node on the half-edge lattice (the paper's figure 3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.geodesic import Geodesic, angle_between
from rendezview_ground.learn.options import Neighbourhood

Indices = npt.NDArray[np.intp]

_RING_OF_IN = 2  # half edges: one edge
_RINGS_OF_OUT = (4, 5)  # half edges: 2 and 2.5 edges
_OUTERMOST_EDGES = 3.0  # "up to three edge lengths"
# Six-valent nodes have 1 + 6 + 6 + 6 in-views and 54 out-views, five-valent ones 5/6 of both.
_OUT_PER_VALENCE = 9


def neighbourhood(lattice: Geodesic, node: int, reading: Neighbourhood) -> tuple[Indices, Indices]:
    """In-views and out-views of a node, as ascending indices of the lattice.

    Args:
        lattice: the sphere of the next order after that of the nodes.
        node: index of the node.
        reading: interpretation of the paper's "73 views".
    """
    rings = _rings(lattice, node, max(_RINGS_OF_OUT))
    inside = np.sort(np.concatenate(rings[: _RING_OF_IN + 1]))
    if reading is Neighbourhood.RINGS:
        return inside, np.sort(np.concatenate([rings[k] for k in _RINGS_OF_OUT]))
    direction = lattice.nodes[node]
    edge = 2.0 * float(np.mean(angle_between(lattice.nodes[rings[1]], direction)))
    near = lattice.within(direction, (_OUTERMOST_EDGES + 0.1) * edge)
    others = near[~np.isin(near, inside)]
    distance = angle_between(lattice.nodes[others], direction)
    if reading is Neighbourhood.ALL:
        return inside, others[distance <= _OUTERMOST_EDGES * edge]
    count = _OUT_PER_VALENCE * len(rings[1])
    return inside, np.sort(others[np.argsort(distance, kind="stable")[:count]])


def _rings(lattice: Geodesic, node: int, last: int) -> list[Indices]:
    """Nodes at 0, 1, 2 … edges of the lattice from a node."""
    seen = {node}
    rings = [np.array([node])]
    for _ in range(last):
        around = {n for k in rings[-1] for n in lattice.neighbours(int(k))} - seen
        seen |= around
        rings.append(np.array(sorted(around)))
    return rings
