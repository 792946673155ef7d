"""Look-alikes: the turns that nearly map a craft onto itself, found from its mesh.

Every rotation of a grid, with and without a reflection, moves some surface points, and a distance
grid tells how far they come to lie from the surface. The best are moved exactly by trimmed
iterative closest points (D. Chetverikov et al., ICPR 2002) against the planes of the surface
(Y. Chen and G. Medioni, Object modelling by registration of multiple range images, 1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rendezview.geometry import so3
from rendezview.geometry.pose import Array, rotation_angle
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.turned_surface import TurnedSurface

_COARSE_POINTS, _ICP_POINTS = 400, 800  # on the surface
_ROUGH_POINTS = 10_000  # of the surface, that points come near to at first
_STEP_RAD = np.deg2rad(12.0)  # of the grid of rotations
_ON_SURFACE = 0.01  # of the radius; a moved point this near to the surface falls onto it
_LEAST_LAST_TRIM = 0.003  # of the radius; at last half of the points move a turn
_TRIMMED, _LEAST_TRIM = 0.8, 0.03  # share of the points, and of the radius, that move a turn
_ROUNDS, _LAST_ROUNDS = 15, 8  # of closest points; the last of them with the nearest half only
_REACH = 0.15  # of the radius: a point farther from the surface moves nothing
_LEAST_USED = 30  # of them
_SETTLED = 3e-4  # rad, and of the radius
_DAMPING = 1e-4  # of the planes' weight: what they leave open does not move
_MOST_STEP = 0.2  # rad, and of the radius
_TRIED = 48  # turns of each kind that are moved exactly
_MULTIPLIED, _KNOWN_RAD = 12, np.deg2rad(2.0)  # likest turns, and how near a product is known
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
    surface = TurnedSurface.of(mesh, seed)
    rough = cKDTree(surface.points_m[:_ROUGH_POINTS])
    found = [one for mirrored in (False, True) for one in _turns(surface, rough, mirrored)]
    found.sort(key=lambda one: -one.alike)
    # Two near-symmetries, one after the other, are a third, which the grid may have missed.
    for one, other in product(found[:_MULTIPLIED], repeat=2):
        turn = one.turn @ other.turn
        if all(_angle(turn, known.turn) > _KNOWN_RAD for known in found):
            found.append(_moved(surface, rough, turn))
    found.sort(key=lambda one: -one.alike)
    kept: list[NearSymmetry] = []
    for one in found:
        if _angle(one.turn, np.eye(3)) < _NO_TURN_RAD or len(kept) == _MOST:
            continue
        if one.alike < _LEAST_ALIKE and len(kept) >= _LEAST_KEPT:
            continue
        if all(_angle(one.turn, other.turn) > _KEPT_APART_RAD for other in kept):
            kept.append(one)
    # About the view centre: c + S (x − c) + t, with c the centroid seen from there.
    off = surface.centroid_m - centre_m
    return [NearSymmetry(one.turn, one.shift_m + off - one.turn @ off, one.alike) for one in kept]


def _angle(a: Array, b: Array) -> float:
    """Between two turns; that of a rotation and a reflection is infinite."""
    between = a @ b.T
    if np.linalg.det(between) < 0.0:
        return float("inf")
    return rotation_angle(between)


def _turns(surface: TurnedSurface, rough: cKDTree, mirrored: bool) -> list[NearSymmetry]:
    """The likest rotations about the centroid, or rotations with a reflection."""
    grid = rotation_grid(_STEP_RAD)
    if mirrored:
        grid = -grid
    chosen: list[int] = []
    for k in np.argsort(surface.distances(grid, _COARSE_POINTS), kind="stable"):
        if all(_angle(grid[k], grid[j]) > _TRIED_APART_RAD for j in chosen):
            chosen.append(int(k))
        if len(chosen) == _TRIED:
            break
    return [_moved(surface, rough, grid[k]) for k in chosen]


def _moved(surface: TurnedSurface, rough: cKDTree, turn: Array) -> NearSymmetry:
    """The near-symmetry next to a turn; ``rough``: of the first points, for the first rounds."""
    own, shift = surface.points_m[surface.tested[:_ICP_POINTS]], np.zeros(3)
    near_m, reach_m = _ON_SURFACE * surface.radius_m, _REACH * surface.radius_m
    for k in range(_ROUNDS):
        moved, tree = own @ turn.T + shift, rough if k < _ROUNDS - _LAST_ROUNDS else surface.tree
        far, nearest = tree.query(moved, distance_upper_bound=reach_m)
        limit = max(
            _LEAST_TRIM * surface.radius_m, float(np.quantile(far, _TRIMMED, method="lower"))
        )
        if k >= _ROUNDS - _LAST_ROUNDS:  # parts that differ would draw it aside
            limit = max(
                _LEAST_LAST_TRIM * surface.radius_m, float(np.quantile(far, 0.5, method="lower"))
            )
        used = (far <= limit) & np.isfinite(far)
        if np.count_nonzero(used) < _LEAST_USED:
            break
        step = _step(surface, moved[used], nearest[used])
        small = so3.exp(step[:3])
        turn, shift = small @ turn, small @ shift + surface.radius_m * step[3:]
        if k >= _ROUNDS - _LAST_ROUNDS and np.abs(step).max() < _SETTLED:
            break
    forth, _ = surface.tree.query(own @ turn.T + shift, distance_upper_bound=near_m)
    back, _ = surface.tree.query((own - shift) @ turn, distance_upper_bound=near_m)
    return NearSymmetry(turn, shift, 0.5 * float((forth < near_m).mean() + (back < near_m).mean()))


def _step(surface: TurnedSurface, moved: Array, nearest: npt.NDArray[np.intp]) -> Array:
    """(6,) rotation vector, and shift of the radius, that brings points to their planes."""
    at, normals = moved / surface.radius_m, surface.normals[nearest]
    off = np.einsum("ni,ni->n", normals, surface.points_m[nearest] / surface.radius_m - at)
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
