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
from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.turned_surface import TurnedSurface

_COARSE_POINTS, _ICP_POINTS = 400, 800  # on the surface
_ROUGH_POINTS, _ROUGH_TESTED = 5_000, 400  # of the surface, and that come near to them at first
_STEP_RAD = np.deg2rad(12.0)  # of the grid of rotations
_ON_SURFACE = 0.01  # of the radius; a moved point this near to the surface falls onto it
_LEAST_LAST_TRIM = 0.003  # of the radius; at last half of the points move a turn
_TRIMMED, _LEAST_TRIM = 0.8, 0.03  # share of the points, and of the radius, that move a turn
_ROUGH_ROUNDS, _LAST_ROUNDS = 7, 8  # of closest points; the last with the nearest half only
_REACH = 0.15  # of the radius: a point farther from the surface moves nothing
_LEAST_USED = 30  # of them
# Share that is near after the rough rounds; of two meshes no turn that began with less than 0.42
# mapped 0.6 in the end. So many are moved exactly whatever they map.
_LIKELY, _LEAST_MOVED = 0.38, 16
_SETTLED = 3e-4  # rad, and of the radius
_DAMPING = 1e-4  # of the planes' weight: what they leave open does not move
_MOST_STEP = 0.2  # rad, and of the radius
_TRIED = 48  # turns of each kind
_MULTIPLIED, _KNOWN_RAD = 12, np.deg2rad(2.0)  # likest turns, and how near another is known
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
    near = [_roughly(surface, rough, turn) for turn in _starts(surface)]
    found = _apart(surface, rough, near, [])
    # Two near-symmetries, one after the other, are a third, which the grid may have missed.
    likest = [one.turn for one in found if one.alike >= _LEAST_ALIKE][:_MULTIPLIED]
    products = [one @ other for one, other in product(likest, repeat=2)]
    turns = [one.turn for one in found]
    unknown = [turn for turn in products if _is_apart(turn, turns)]
    near = [_roughly(surface, rough, turn) for turn in unknown]
    found += _apart(surface, rough, near, turns)
    found.sort(key=lambda one: -one.alike)
    kept: list[NearSymmetry] = []
    for one in found:
        if not _is_apart(one.turn, [np.eye(3)], _NO_TURN_RAD) or len(kept) == _MOST:
            continue
        if one.alike < _LEAST_ALIKE and len(kept) >= _LEAST_KEPT:
            continue
        if _is_apart(one.turn, [other.turn for other in kept], _KEPT_APART_RAD):
            kept.append(one)
    # About the view centre: c + S (x − c) + t, with c the centroid seen from there.
    off = surface.centroid_m - centre_m
    return [NearSymmetry(one.turn, one.shift_m + off - one.turn @ off, one.alike) for one in kept]


def _apart(
    surface: TurnedSurface, rough: cKDTree, near: list[NearSymmetry], known: list[Array]
) -> list[NearSymmetry]:
    """Exactly, the likest first: many starts come to the same turn, and many to none."""
    apart, known = [], list(known)
    for one in sorted(near, key=lambda one: -one.alike):
        if one.alike < _LIKELY and len(known) >= _LEAST_MOVED:
            break
        if _is_apart(one.turn, known):
            known.append(one.turn)
            apart.append(_exactly(surface, rough, one))
    return sorted(apart, key=lambda one: -one.alike)


def _is_apart(turn: Array, known: list[Array], apart_rad: float = _KNOWN_RAD) -> bool:
    """Whether no known turn is so near; no rotation is near a reflection."""
    if not known:
        return True
    others = np.stack(known)
    alike = np.linalg.det(others) * np.linalg.det(turn) > 0.0
    # Of turns between two that are alike, the trace is 1 + 2 cos of the angle.
    cosines = 0.5 * (np.einsum("nij,ij->n", others, turn) - 1.0)
    return not np.any(alike & (cosines >= np.cos(apart_rad)))


def _starts(surface: TurnedSurface) -> list[Array]:
    """The likest rotations of a grid about the centroid, and rotations with a reflection."""
    chosen: list[Array] = []
    for grid in (rotation_grid(_STEP_RAD), -rotation_grid(_STEP_RAD)):
        own: list[Array] = []
        for k in np.argsort(surface.distances(grid, _COARSE_POINTS), kind="stable"):
            if _is_apart(grid[k], own, _TRIED_APART_RAD):
                own.append(grid[k])
            if len(own) == _TRIED:
                break
        chosen += own
    return chosen


def _roughly(surface: TurnedSurface, rough: cKDTree, turn: Array) -> NearSymmetry:
    """A turn moved by few points to few; its share is of those that come near."""
    own, shift = surface.points_m[surface.tested[:_ROUGH_TESTED]], np.zeros(3)
    reach_m, near_m = _REACH * surface.radius_m, _LEAST_TRIM * surface.radius_m
    alike = 0.0
    for _ in range(_ROUGH_ROUNDS):
        moved = own @ turn.T + shift
        far, nearest = rough.query(moved, distance_upper_bound=reach_m)
        alike = float((far <= near_m).mean())
        limit = max(near_m, float(np.quantile(far, _TRIMMED, method="lower")))
        used = (far <= limit) & np.isfinite(far)
        if np.count_nonzero(used) < _LEAST_USED:
            break
        turn, shift, _ = _stepped(surface, turn, shift, moved[used], nearest[used])
    return NearSymmetry(turn, shift, alike)


def _exactly(surface: TurnedSurface, rough: cKDTree, start: NearSymmetry) -> NearSymmetry:
    """The near-symmetry next to another: the nearest half moves it, parts that differ do not."""
    own, turn, shift = surface.points_m[surface.tested[:_ICP_POINTS]], start.turn, start.shift_m
    near_m, reach_m = _ON_SURFACE * surface.radius_m, _REACH * surface.radius_m
    least_m = _LEAST_LAST_TRIM * surface.radius_m
    for _ in range(_LAST_ROUNDS):
        moved = own @ turn.T + shift
        # To few points it is farther than to all: beyond their middle nothing is used, and far
        # points take ten times as long.
        fewer, _ = rough.query(moved, distance_upper_bound=reach_m)
        most_m = min(1.001 * max(least_m, float(np.quantile(fewer, 0.5, method="lower"))), reach_m)
        far, nearest = surface.tree.query(moved, distance_upper_bound=most_m)
        middle_m = float(np.quantile(far, 0.5, method="lower"))
        used = (far <= max(least_m, middle_m)) & np.isfinite(far)
        if np.count_nonzero(used) < _LEAST_USED:
            break
        turn, shift, largest = _stepped(surface, turn, shift, moved[used], nearest[used])
        if largest < _SETTLED:
            break
    forth, _ = surface.tree.query(own @ turn.T + shift, distance_upper_bound=near_m)
    back, _ = surface.tree.query((own - shift) @ turn, distance_upper_bound=near_m)
    return NearSymmetry(turn, shift, 0.5 * float((forth < near_m).mean() + (back < near_m).mean()))


def _stepped(
    surface: TurnedSurface, turn: Array, shift: Array, moved: Array, nearest: npt.NDArray[np.intp]
) -> tuple[Array, Array, float]:
    """Turn and shift after a step to the planes, and the step's largest component."""
    step = _step(surface, moved, nearest)
    small = so3.exp(step[:3])
    shift = small @ shift + surface.radius_m * step[3:]
    return small @ turn, shift, float(np.abs(step).max())


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
