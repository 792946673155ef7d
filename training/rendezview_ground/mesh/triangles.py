"""Triangles of a mesh: normals, random points, and the edges that they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendezview.geometry.pose import Array


def crosses(corners: Array) -> Array:
    """(F, 3) normals of triangles (F, 3, 3), as long as twice their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def twice_areas(corners: Array) -> Array:
    """(F,) of triangles (F, 3, 3)."""
    return np.asarray(np.linalg.norm(crosses(corners), axis=1))


def random_points(
    corners: Array, weights: Array, count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Points (N, 3) on triangles (F, 3, 3), uniform on each, and the triangle of each.

    Args:
        weights: (F,) in proportion to which a triangle is chosen.
    """
    chosen = rng.choice(len(corners), size=count, p=weights / weights.sum())
    a, b = rng.random((2, count, 1))
    flip = a + b > 1.0
    a, b = np.where(flip, 1.0 - a, a), np.where(flip, 1.0 - b, b)
    p, q, r = np.moveaxis(corners[chosen], 1, 0)
    return p + a * (q - p) + b * (r - p), chosen


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """The edges of a mesh and their faces."""

    ends: NDArray[np.int64]  # (E, 2)
    count: NDArray[np.int64]  # (E,) faces
    balanced: NDArray[np.bool_]  # (E,) passed once in each direction
    faces: NDArray[np.int64]  # (E, 2) first and last face

    @classmethod
    def of(cls, faces: NDArray[np.integer]) -> Edges:
        """Of faces (F, 3), equal positions merged."""
        each = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        forward = each[:, 0] < each[:, 1]
        key = each.min(axis=1) * (int(faces.max()) + 1) + each.max(axis=1)
        order = np.argsort(key, kind="stable")
        _, first, count = np.unique(key[order], return_index=True, return_counts=True)
        passed = np.add.reduceat(forward[order].astype(np.int64), first)
        owner = order // 3
        ends = np.sort(each[order[first]], axis=1)
        pair = np.column_stack([owner[first], owner[first + count - 1]])
        return cls(ends, count, passed == 1, pair)

    @property
    def open_edges(self) -> NDArray[np.int64]:
        """(K, 2) of one face."""
        return np.asarray(self.ends[self.count == 1])

    @property
    def mixed_edges(self) -> NDArray[np.int64]:
        """(K, 2) of two faces that are wound in opposite directions."""
        return np.asarray(self.ends[(self.count == 2) & ~self.balanced])
