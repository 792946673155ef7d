"""The surface of a mesh, and how much of it a turn about its own centroid leaves in place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.triangles import crosses, random_points

# Of the radius; a turned point this close to the surface lies on it. Source: a pixel of a view
_SAME = 0.015
_DENSITY = 5.0  # points on a square of that size: one in 6 million discs has none
_MOST_POINTS = 400_000  # Source: a second to build the tree
_REACH = 2.3  # spacings; as likely is a disc without a point where there are that many
_FEW, _TESTED = 300, 6000  # points of a first and of the whole test
_HOPELESS = 0.97  # share of the few; below it the whole test is left out. Source: by construction
_ALBEDO = 0.1  # a larger difference is seen. Source: a visible crease, 0.12
_NEIGHBOURS = 8  # points around whose albedo counts: next to a seam there are two
_CELLS = 64  # of the distance grid, along an axis
_CUT = 0.15  # of the radius; larger distances count as this
_POLISHED = 300  # points
_LEAST_NEAR = 0.5  # share of them near the surface; with fewer it is no symmetry
_ROUNDS = 12
_STILL_RAD = 1e-4  # a smaller step ends the rounds
_LARGEST_STEP_RAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class TurnedSurface:
    """Points on a surface, from its area centroid.

    A turn that maps the surface onto itself keeps the centroid and the second moments.
    """

    centroid_m: Array  # (3,)
    radius_m: float  # of the farthest vertex from the centroid
    moments: Array  # (3, 3) mean of p pᵀ over the surface, m²
    points_m: Array  # (N, 3) at random, uniform over the area
    normals: Array  # (N, 3) unit
    albedo: Array  # (N,)
    tested: NDArray[np.int64]  # (T,) some of them
    tree: cKDTree
    reach_m: float  # at most so far from a point on the surface is its nearest sample
    grid_m: NDArray[np.float32]  # (C, C, C) distance from the surface

    @classmethod
    def of(cls, mesh: Mesh, seed: int) -> TurnedSurface:
        """Sample a mesh; faces that are there twice count once."""
        _, first = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)
        first.sort()
        corners = mesh.vertices_m[mesh.faces[first]]
        normals = crosses(corners)
        twice = np.linalg.norm(normals, axis=1)
        share = twice / twice.sum()
        centroid = share @ corners.mean(axis=1)
        corners = corners - centroid
        radius_m = float(np.linalg.norm(corners, axis=2).max())
        # A triangle's moments: (Σ vᵢ vᵢᵀ + (Σ vᵢ)(Σ vᵢ)ᵀ) / 12.
        sums = corners.sum(axis=1)
        moments = np.einsum("f,fij,fik->jk", share / 12.0, corners, corners)
        moments += np.einsum("f,fj,fk->jk", share / 12.0, sums, sums)
        same_m = _SAME * radius_m
        area_m2 = 0.5 * float(twice.sum())
        count = int(np.clip(_DENSITY * area_m2 / same_m**2, 2 * _TESTED, _MOST_POINTS))
        rng = np.random.default_rng(seed)
        points, chosen = random_points(corners, twice, count, rng)
        free = np.ones((_CELLS,) * 3, dtype=bool)
        cell_m = _cell_m(radius_m)
        free[tuple(np.floor(points / cell_m + _CELLS / 2).astype(np.int64).T)] = False
        return cls(
            centroid_m=np.asarray(centroid),
            radius_m=radius_m,
            moments=moments,
            points_m=points,
            normals=(normals / np.maximum(twice, 1e-300)[:, None])[chosen],
            albedo=mesh.face_albedo[first][chosen],
            tested=rng.choice(count, size=_TESTED, replace=False),
            tree=cKDTree(points),
            reach_m=max(same_m, _REACH * float(np.sqrt(area_m2 / count))),
            grid_m=(cell_m * distance_transform_edt(free)).astype(np.float32),
        )

    def distances(self, turns: Array, points: int) -> Array:
        """(K,) mean distance of turned points from the surface, coarsely, in radii.

        Args:
            turns: (K, 3, 3).
            points: how many are turned.
        """
        own, cell_m = self.points_m[self.tested[:points]], _cell_m(self.radius_m)
        means = np.empty(len(turns))
        for k in range(0, len(turns), 500):
            turned = turns[k : k + 500] @ own.T  # (500, 3, points)
            i = np.clip((turned / cell_m + _CELLS / 2).astype(np.int32), 0, _CELLS - 1)
            away = self.grid_m[i[:, 0], i[:, 1], i[:, 2]] / self.radius_m
            means[k : k + 500] = np.minimum(away, _CUT).mean(axis=1)
        return means

    def share_in_place(self, turn: Array) -> float:
        """Share of the surface that a turn (3, 3) puts onto a surface of the same albedo."""
        share = self._in_place(turn, self.tested[:_FEW])
        return share if share < _HOPELESS else self._in_place(turn, self.tested)

    def _in_place(self, turn: Array, own: NDArray[np.int64]) -> float:
        turned = self.points_m[own] @ turn.T
        away, near = self.tree.query(turned, distance_upper_bound=self.reach_m)
        there = np.flatnonzero(np.isfinite(away))
        near = near[there]
        off = np.einsum("ni,ni->n", turned[there] - self.points_m[near], self.normals[near])
        there = there[np.abs(off) <= _SAME * self.radius_m]
        if np.ptp(self.albedo) > _ALBEDO and len(there):
            _, around = self.tree.query(
                turned[there], k=_NEIGHBOURS, distance_upper_bound=self.reach_m
            )
            albedo = np.append(self.albedo, np.inf)[around]  # infinite where there are fewer
            apart = np.abs(albedo - self.albedo[own[there], None]).min(axis=1)
            there = there[apart <= _ALBEDO]
        return len(there) / len(own)

    def polished(self, turn: Array) -> Array:
        """The turn (3, 3) next to another that maps the surface onto itself best.

        Points go to the planes of their nearest neighbours (Chen and Medioni 1992): points that go
        to points hold each other back on a flat face.
        """
        own = self.points_m[self.tested[:_POLISHED]]
        for _ in range(_ROUNDS):
            turned = own @ turn.T
            away, near = self.tree.query(turned, distance_upper_bound=_CUT * self.radius_m)
            middle = float(np.quantile(away, 0.85, method="lower"))
            used = away <= min(max(middle, self.reach_m), _CUT * self.radius_m)
            if used.mean() < _LEAST_NEAR:
                break
            turned, near = turned[used], near[used]
            normals = self.normals[near]
            jacobian = np.cross(turned, normals)
            off = np.einsum("ni,ni->n", normals, self.points_m[near] - turned)
            damping = 1e-6 * self.radius_m**2 * len(off) * np.eye(3)
            step = np.linalg.solve(jacobian.T @ jacobian + damping, jacobian.T @ off)
            length = float(np.linalg.norm(step))
            step *= min(1.0, _LARGEST_STEP_RAD / max(length, 1e-12))
            turn = so3.exp(step) @ turn
            if length < _STILL_RAD:
                break
        return np.asarray(turn)


def _cell_m(radius_m: float) -> float:
    return 2.4 * radius_m / _CELLS
