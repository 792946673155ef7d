"""The geodesic sphere of views: repeated bisection of the icosahedron.

Cleghorn & Sternberg, eq. 1–3: ``faces_i = 20·4^i``, ``edges_i = 1.5·faces_i``,
``nodes_i = nodes_{i-1} + edges_{i-1}``, ``nodes_0 = 12``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array

MAX_ORDER = 6  # 40,962 nodes, 1.1° apart. Source: by construction


@dataclass(frozen=True, eq=False)
class Geodesic:
    """A geodesic sphere of the given order; its first nodes are those of the order below.

    The mid-points of the edges of order n are, projected to the sphere, the nodes
    that order n + 1 adds, so the nodes of order n + 1 are the half-edge lattice of
    order n.
    """

    order: int
    nodes: Array  # (N, 3) unit vectors
    faces: npt.NDArray[np.int32]  # (F, 3) node indices, counter-clockwise from outside

    @classmethod
    def of_order(cls, order: int) -> Geodesic:
        """The sphere of an order from 0 (icosahedron, 12 nodes) to 6 (40,962 nodes).

        Raises:
            ValueError: the order is out of range.
        """
        if not 0 <= order <= MAX_ORDER:
            raise ValueError(f"the order of the geodesic sphere must be 0 to {MAX_ORDER}: {order}")
        return _of_order(order)

    @cached_property
    def edges(self) -> npt.NDArray[np.int32]:
        """(E, 2) pairs of neighbouring nodes, lower index first, sorted."""
        return _edges(self.faces)

    @cached_property
    def _neighbours(self) -> list[list[int]]:
        around: list[list[int]] = [[] for _ in self.nodes]
        for a, b in self.edges.tolist():
            around[a].append(b)
            around[b].append(a)
        return around

    def neighbours(self, node: int) -> list[int]:
        """The five or six nodes that share an edge with a node, ascending."""
        return sorted(self._neighbours[node])

    @cached_property
    def mean_edge_rad(self) -> float:
        """Mean angle between neighbouring nodes, radians."""
        a, b = self.nodes[self.edges[:, 0]], self.nodes[self.edges[:, 1]]
        return float(np.mean(angle_between(a, b)))

    def within(self, direction: npt.ArrayLike, angle_rad: float) -> npt.NDArray[np.intp]:
        """Indices of the nodes at most ``angle_rad`` from a unit direction (3,), ascending."""
        return within(self.nodes, direction, angle_rad)

    def nearest(self, directions: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Index of the node nearest to each unit direction (..., 3)."""
        cosines = np.asarray(directions, dtype=np.float64) @ self.nodes.T
        return np.asarray(np.argmax(cosines, axis=-1), dtype=np.intp)


def within(
    directions: npt.NDArray[np.floating], direction: npt.ArrayLike, angle_rad: float
) -> npt.NDArray[np.intp]:
    """Indices of unit directions (N, 3) at most ``angle_rad`` from another (3,), ascending."""
    cosine = cosine_within(angle_rad, single=directions.dtype != np.float64)
    return np.flatnonzero(directions @ np.asarray(direction, dtype=directions.dtype) >= cosine)


def cosine_within(angle_rad: float, *, single: bool = False) -> float:
    """Least cosine of unit directions at most ``angle_rad`` apart, with room for rounding.

    ``single``: of directions in single precision, which is off by 1e-7.
    """
    return float(np.cos(min(angle_rad, np.pi)) - (1e-6 if single else 1e-12))


def angle_between(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Angle between unit vectors (..., 3), radians; exact near 0 and π."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    return np.asarray(
        2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    )


def _edges(faces: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0)


@lru_cache(maxsize=MAX_ORDER + 1)
def _of_order(order: int) -> Geodesic:
    if order == 0:
        return _icosahedron()
    below = _of_order(order - 1)
    edges, nodes = below.edges, below.nodes
    middles = nodes[edges[:, 0]] + nodes[edges[:, 1]]
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    index = {(int(a), int(b)): len(nodes) + k for k, (a, b) in enumerate(edges)}

    def middle(a: int, b: int) -> int:
        return index[(a, b) if a < b else (b, a)]

    faces = []
    for a, b, c in below.faces.tolist():
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        faces += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return _frozen(order, np.vstack([nodes, middles]), np.array(faces, dtype=np.int32))


def _icosahedron() -> Geodesic:
    golden = (1.0 + 5.0**0.5) / 2.0
    corners = [
        p
        for a in (-1.0, 1.0)
        for b in (-golden, golden)
        for p in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
    ]
    nodes = np.array(sorted(corners)) / np.hypot(1.0, golden)
    edge = np.min(np.linalg.norm(nodes[1:] - nodes[0], axis=1)) * 1.01
    near = np.linalg.norm(nodes[:, None] - nodes[None], axis=2) < edge
    faces = [
        (a, b, c) if np.linalg.det(nodes[[a, b, c]]) > 0 else (a, c, b)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    return _frozen(0, nodes, np.array(faces, dtype=np.int32))


def _frozen(order: int, nodes: Array, faces: npt.NDArray[np.int32]) -> Geodesic:
    nodes.setflags(write=False)
    faces.setflags(write=False)
    return Geodesic(order, nodes, faces)
