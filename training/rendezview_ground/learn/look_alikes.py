"""Look-alikes: the turns that nearly map a craft onto itself, found from its mesh.

Every rotation of a grid, with and without a reflection, moves some surface points; a distance grid
tells how far they come to lie from the surface. The best are moved exactly by trimmed iterative
closest points (D. Chetverikov et al., ICPR 2002) against the planes of the surface (Y. Chen and
G. Medioni, Object modelling by registration of multiple range images, 1992): a point may slide.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.surface_sample import sample_with_normals

_STREAM = 8  # of random numbers
_POINTS, _COARSE_POINTS, _ICP_POINTS = 20_000, 400, 1500  # on the surface
_CELLS = 72  # of the distance grid, a side
_GRID_SIDE_RADII = 2.4  # of the distance grid
_STEP_RAD = np.deg2rad(12.0)  # of the grid of rotations
_FARTHEST = 0.15  # of the radius: what lies farther off counts no more
_ON_SURFACE = 0.02  # of the radius; a moved point this near to the surface falls onto it
_TRIMMED, _LEAST_TRIM = 0.8, 0.03  # share of the points, and of the radius, that move a turn
_ROUNDS, _LAST_ROUNDS = 15, 5  # of closest points; the last of them with the nearest only
_LEAST_USED = 30  # of them
_SETTLED = 3e-4  # rad, and of the radius
_DAMPING = 1e-4  # of the planes' weight: what they leave open does not move
_MOST_STEP = 0.2  # rad, and of the radius
_TRIED = 48  # turns of each kind that are moved exactly
_MOST = 48  # that are kept
_LEAST_KEPT = 6  # likest turns that are kept whatever they map …
_LEAST_ALIKE = 0.6  # … and of the others those that map as much of the surface
_TRIED_APART_RAD, _KEPT_APART_RAD = np.deg2rad(20.0), np.deg2rad(6.0)
_NO_TURN_RAD = np.deg2rad(12.0)  # a smaller rotation is no other pose


@dataclass(frozen=True, slots=True)
class NearSymmetry:
    """x → turn x + shift about the view centre maps a share of the surface onto the surface."""

    turn: Array  # (3, 3) in O(3)
    shift_m: Array  # (3,)
    alike: float


def look_alikes(mesh: Mesh, centre_m: Array, seed: int = 0) -> list[NearSymmetry]:
    """The likest near-symmetries of a mesh, most of its surface first.

    Args:
        mesh: of the target.
        centre_m: (3,) that the views look at; turns and shifts are about it.
        seed: of the surface points.
    """
    search = _Search.of(mesh, np.random.default_rng([seed, _STREAM]))
    found = [one for mirrored in (False, True) for one in search.turns(mirrored)]
    found.sort(key=lambda one: -one.alike)
    kept: list[NearSymmetry] = []
    for one in found:
        if _angle(one.turn, np.eye(3)) < _NO_TURN_RAD or len(kept) == _MOST:
            continue
        if one.alike < _LEAST_ALIKE and len(kept) >= _LEAST_KEPT:
            continue
        if all(_angle(one.turn, other.turn) > _KEPT_APART_RAD for other in kept):
            kept.append(one)
    # About the view centre: c + S (x − c) + t, with c the middle of the surface seen from there.
    off = search.middle_m - centre_m
    return [NearSymmetry(one.turn, one.shift_m + off - one.turn @ off, one.alike) for one in kept]


def _angle(a: Array, b: Array) -> float:
    """Between two turns; that of a rotation and a reflection is infinite."""
    between = a @ b.T
    if np.linalg.det(between) < 0.0:
        return float("inf")
    return float(np.arccos(np.clip(0.5 * (np.trace(between) - 1.0), -1.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """Surface points about their middle, a tree of them, and their distance grid."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    middle_m: Array
    radius_m: float
    distance: npt.NDArray[np.float32]  # (C, C, C) m
    some: Array  # (M, 3) of the points
    tree: cKDTree = field(repr=False)

    @classmethod
    def of(cls, mesh: Mesh, rng: np.random.Generator) -> _Search:
        points, normals = sample_with_normals(mesh, _POINTS, rng)
        middle_m = points.mean(axis=0)
        points = points - middle_m
        radius_m = float(np.linalg.norm(points, axis=1).max())
        empty = np.ones((_CELLS,) * 3, dtype=np.bool_)
        side_m = _GRID_SIDE_RADII * radius_m / _CELLS
        empty[tuple(np.floor(points / side_m + _CELLS / 2).astype(int).T)] = False
        distance = (distance_transform_edt(empty) * side_m).astype(np.float32)
        some = points[:_ICP_POINTS]
        return cls(points, normals, middle_m, radius_m, distance, some, cKDTree(points))

    def turns(self, mirrored: bool) -> list[NearSymmetry]:
        """The likest rotations, or rotations with a reflection."""
        grid = rotation_grid(_STEP_RAD)
        if mirrored:
            grid = -grid
        far = np.concatenate([self._distances(part) for part in np.array_split(grid, 40)])
        chosen: list[int] = []
        for k in np.argsort(far, kind="stable"):
            if all(_angle(grid[k], grid[j]) > _TRIED_APART_RAD for j in chosen):
                chosen.append(int(k))
            if len(chosen) == _TRIED:
                break
        return [self._moved(grid[k]) for k in chosen]

    def _distances(self, turns: Array) -> npt.NDArray[np.float32]:
        """(K,) mean distance of turned points from the surface, of the radius."""
        turned = np.einsum("kij,nj->kni", turns, self.points[:_COARSE_POINTS])
        side_m = _GRID_SIDE_RADII * self.radius_m / _CELLS
        cells = np.clip(np.floor(turned / side_m + _CELLS / 2).astype(np.int32), 0, _CELLS - 1)
        far = self.distance[cells[..., 0], cells[..., 1], cells[..., 2]] / self.radius_m
        return np.asarray(np.minimum(far, _FARTHEST).mean(axis=1))

    def _moved(self, turn: Array) -> NearSymmetry:
        """The near-symmetry next to a turn."""
        shift = np.zeros(3)
        for k in range(_ROUNDS):
            moved = self.some @ turn.T + shift
            far, nearest = self.tree.query(moved)
            limit = max(_LEAST_TRIM * self.radius_m, float(np.quantile(far, _TRIMMED)))
            if k >= _ROUNDS - _LAST_ROUNDS:
                limit = _ON_SURFACE * self.radius_m  # parts that differ would draw it aside
            used = far <= limit
            if np.count_nonzero(used) < _LEAST_USED:
                break
            step = self._step(moved[used], nearest[used])
            small = Rotation.from_rotvec(step[:3]).as_matrix()
            turn, shift = small @ turn, small @ shift + self.radius_m * step[3:]
            if k >= _ROUNDS - _LAST_ROUNDS and np.abs(step).max() < _SETTLED:
                break
        forth, _ = self.tree.query(self.some @ turn.T + shift)
        back, _ = self.tree.query((self.some - shift) @ turn)
        near = _ON_SURFACE * self.radius_m
        return NearSymmetry(turn, shift, 0.5 * float((forth < near).mean() + (back < near).mean()))

    def _step(self, moved: Array, nearest: npt.NDArray[np.intp]) -> Array:
        """(6,) rotation vector, and shift of the radius, that brings points to their planes."""
        at, normals = moved / self.radius_m, self.normals[nearest]
        off = np.einsum("ni,ni->n", normals, self.points[nearest] / self.radius_m - at)
        slopes = np.concatenate([np.cross(at, normals), normals], axis=1)
        weight = slopes.T @ slopes + _DAMPING * len(at) * np.eye(6)
        step = np.linalg.solve(weight, slopes.T @ off)
        return np.asarray(step * min(1.0, _MOST_STEP / max(float(np.abs(step).max()), 1e-12)))


def rotation_grid(step_rad: float) -> Array:
    """(N, 3, 3) rotations about so far apart: axes on a spiral, turned about themselves."""
    count = round(4.0 * np.pi / step_rad**2)
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    tilts = Rotation.from_rotvec(
        polar[:, None] * np.stack([-np.sin(around), np.cos(around), np.zeros(count)], axis=1)
    )
    rolls = Rotation.from_rotvec(np.outer(np.arange(0.0, 2.0 * np.pi, step_rad), [0.0, 0.0, 1.0]))
    both = np.einsum("nij,rjk->nrik", tilts.as_matrix(), rolls.as_matrix())
    return np.asarray(both.reshape(-1, 3, 3))
