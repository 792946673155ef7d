"""Symmetries of a mesh, found from its surface.

A turn that changes nothing keeps the area centroid of the surface, through which its axis passes,
and the second moments. These leave few axes: three where the moments differ, one and those across
it where two are equal, and any where all are. Each is tested on the surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array, minimal_rotation, rotation_angle
from rendezview.geometry.symmetry import Symmetry, common_point, discrete_turns
from rendezview_ground.mesh.directions import axes_towards, perpendicular
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.turned_surface import TurnedSurface

# Least share of the surface in place: an antenna of 0.3 % of the surface breaks a symmetry.
_SHARE = 0.997
_EQUAL = 0.03  # of the largest; moments that differ by less are equal. Source: noise of meshes
_CONTINUOUS_RAD = np.deg2rad([7.0, 31.0, 53.0, 97.0])  # rad; no regular prism has all of them
_MOST_FOLD = 24  # a regular prism with more sides is round. Source: its facets are 0.9 % inside
_ACROSS_RAD = np.deg2rad(1.0)  # between half turns about axes across another
_MOST_ACROSS = 48  # of them that are polished: twice as many as the turns of a prism
_SCAN_AWAY = 0.05  # radii; turns by whole steps that leave points farther away are left out
_GRID_ROLLS = 24  # of each of 642 directions of the grid of all turns: some 8° between two
_GRID_AWAY = 0.075  # radii; the same for the grid, whose steps are larger
_GRID_APART_RAD = np.deg2rad(18.0)  # turns of a body with equal moments are 36° apart, or more
_MOST_OF_GRID = 90  # turns that are polished; an icosahedron has 59
_LEAST_RAD = np.deg2rad(4.0)  # a smaller turn is none
_SAME_RAD = np.deg2rad(2.0)  # turns closer than this are one
_MOST_TURNS = 60  # of a body without a continuous axis: those of an icosahedron
_AT_ORIGIN = 1e-4  # radii; an axis so near to the origin passes through it: 0.01 px of a view
_POINTS = 300, 1000  # that are turned, of the grid and of a scan


def find_symmetries(mesh: Mesh, seed: int = 0) -> tuple[Symmetry, ...]:
    """Discrete and continuous symmetries of a mesh, about any axis through its centroid.

    Shape and albedo count. The symmetries found are few: they generate all others.

    Args:
        mesh: anywhere in its frame.
        seed: of the points on the surface.
    """
    surface = TurnedSurface.of(mesh, seed)
    moments, axes = np.linalg.eigh(surface.moments)
    first, second = np.diff(moments) < _EQUAL * moments[2]
    if not (first or second):
        candidates = [_turn(axis, np.pi) for axis in axes.T]
    elif first and second:
        candidates = []
        for turn in _of_all_turns(surface):
            candidates.append(surface.polished(turn))
            axis = _axis(candidates[-1])
            if axis is not None and _is_continuous(surface, axis):
                return _continuous(surface, axis)
    else:
        axis = axes[:, 2] if first else axes[:, 0]
        if _is_continuous(surface, axis):
            return _continuous(surface, axis)
        candidates = _about(surface, axis)
    return _placed(_found(surface, candidates), surface)


def described(symmetries: Sequence[Symmetry]) -> str:
    """Symmetries in words, after "it" or a name: "looks the same when turned by …"."""
    turns = [
        f"by {'any angle' if s.angle_rad is None else f'{np.rad2deg(s.angle_rad):.4g}°'} "
        f"about ({_numbers(s.axis)})"
        for s in symmetries
    ]
    if not turns:
        return "has no symmetry"
    words = "looks the same when turned " + ", ".join(turns)
    if len(turns) > 1:
        words += ", or by these in turn"
    if all(s.kind == "discrete" for s in symmetries):
        words += f": {len(discrete_turns(symmetries))} attitudes"
    point_m = common_point(symmetries)
    if point_m.any():
        axes = "axis passes" if len(turns) == 1 else "axes pass"
        words += f"; the {axes} through ({_numbers(point_m)}) m"
    return words


def _numbers(vector: Array) -> str:
    return ", ".join(f"{v:.2f}" for v in np.round(vector, 2) + 0.0)


def _placed(found: list[Symmetry], surface: TurnedSurface) -> tuple[Symmetry, ...]:
    """The symmetries through the centroid, without a point if all axes pass through the origin."""
    missed_m = [np.linalg.norm(np.cross(s.axis, surface.centroid_m)) for s in found]
    if max(missed_m, default=0.0) < _AT_ORIGIN * surface.radius_m:
        return tuple(found)
    return tuple(replace(symmetry, point_m=surface.centroid_m) for symmetry in found)


def _turn(axis: Array, angle_rad: float) -> Array:
    return np.asarray(Rotation.from_rotvec(angle_rad * axis).as_matrix())


def _holds(surface: TurnedSurface, turn: Array) -> bool:
    return surface.share_in_place(turn) >= _SHARE


def _is_continuous(surface: TurnedSurface, axis: Array) -> bool:
    return all(_holds(surface, _turn(axis, angle)) for angle in _CONTINUOUS_RAD)


def _forwards(vector: Array) -> Array:
    """The unit vector (3,) along an axis whose largest component is positive."""
    vector = vector / np.linalg.norm(vector)
    return np.asarray(vector * np.sign(vector[np.argmax(np.abs(vector))]) + 0.0)


def _continuous(surface: TurnedSurface, axis: Array) -> tuple[Symmetry, ...]:
    """Any turn about an axis, with what else the body then has: another such axis, or a flip."""
    across = perpendicular(axis)
    found = [Symmetry("continuous", _forwards(axis), None)]
    if _is_continuous(surface, across):
        found.append(Symmetry("continuous", _forwards(across), None))
    elif _holds(surface, _turn(across, np.pi)):
        found.append(Symmetry("discrete", _forwards(across), np.pi))
    return _placed(found, surface)


def _about(surface: TurnedSurface, axis: Array) -> list[Array]:
    """Turns (3, 3) about an axis that may hold, and half turns about axes across it."""
    turns = np.array([_turn(axis, 2.0 * np.pi / order) for order in range(2, _MOST_FOLD + 1)])
    found = list(turns[surface.distances(turns, _POINTS[1]) < _SCAN_AWAY])
    one, other, _ = axes_towards(axis)
    steps = np.arange(0.0, np.pi, _ACROSS_RAD)
    half_turns = [_turn(np.cos(a) * one + np.sin(a) * other, np.pi) for a in steps]
    away = surface.distances(np.array(half_turns), _POINTS[1])
    least = np.flatnonzero((away <= np.roll(away, 1)) & (away <= np.roll(away, -1)))
    least = least[away[least] < _SCAN_AWAY]
    least = least[np.argsort(away[least], kind="stable")][:_MOST_ACROSS]
    return [surface.polished(turn) for turn in [*found, *(half_turns[k] for k in least)]]


def _of_all_turns(surface: TurnedSurface) -> list[Array]:
    """Turns (3, 3) of a grid of all that leave the surface nearly in place, best first."""
    upwards = np.array([0.0, 0.0, 1.0])
    to_nodes = [minimal_rotation(upwards, node) for node in Geodesic.of_order(3).nodes]
    angles = np.linspace(0.0, 2.0 * np.pi, _GRID_ROLLS, endpoint=False)
    rolls = [_turn(upwards, angle) for angle in angles]
    grid = np.einsum("nij,rjk->nrik", to_nodes, rolls).reshape(-1, 3, 3)
    away = surface.distances(grid, _POINTS[0])
    chosen: list[Array] = []
    for k in np.argsort(away, kind="stable"):
        if away[k] > _GRID_AWAY or len(chosen) >= _MOST_OF_GRID:
            break
        if _is_new(grid[k], [np.eye(3), *chosen], _GRID_APART_RAD):
            chosen.append(grid[k])
    return chosen


def _axis(turn: Array) -> Array | None:
    """The axis (3,) of a turn; None: it is hardly one."""
    vector = Rotation.from_matrix(turn).as_rotvec()
    length = float(np.linalg.norm(vector))
    return None if length < _LEAST_RAD else vector / length


def _is_new(turn: Array, known: list[Array], apart_rad: float) -> bool:
    cosines = 0.5 * (np.einsum("kij,ij->k", np.array(known), turn) - 1.0)
    return bool(cosines.max() < np.cos(apart_rad))


def _found(surface: TurnedSurface, candidates: Iterable[Array]) -> list[Symmetry]:
    """Symmetries that generate those turns that hold, and their products."""
    held: list[Array] = []
    for turn in candidates:
        if _is_new(turn, [np.eye(3), *held], _SAME_RAD) and _holds(surface, turn):
            held.append(turn)
    group = _generated(surface, held, _MOST_TURNS)
    found = None if group is None else _generators(_exact(group))
    if found is not None:
        return found
    # A body that is nearly round: many small turns hold, but not their powers.
    group = [np.eye(3)]
    for turn in held:
        if _is_new(turn, group, _SAME_RAD):
            group = _generated(surface, [*group[1:], turn], 0) or group
    return _generators(_exact(group)) or []


def _generated(surface: TurnedSurface, turns: list[Array], may_fail: int) -> list[Array] | None:
    """Turns with their products that hold, the identity first; None: more than a body can have.

    ``may_fail``: so many products may not hold, or only near others; None with more.
    """
    group, failed = [np.eye(3), *turns], 0
    for turn in group:  # grows while it is walked
        for other in list(group):
            product = turn @ other
            if not _is_new(product, group, _SAME_RAD):
                continue
            product = surface.polished(product)
            if _is_new(product, group, _SAME_RAD) and _holds(surface, product):
                group.append(product)
            else:
                failed += 1
            if failed > may_fail or len(group) > _MOST_TURNS:
                return None
    return group


def _exact(turns: list[Array]) -> list[Array]:
    """The turns (3, 3) of a group, freed of their errors.

    Each becomes the mean of what its products with all others say of it, which converges
    quadratically (Grove, Karcher and Ruh, Math. Ann. 211, 1974).
    """
    group = np.array(turns)
    products = np.einsum("aij,bjk->abik", group, group)
    number = np.argmax(np.einsum("abij,cij->abc", products, group), axis=2)
    for _ in range(4):
        mean = np.einsum("abij,bkj->aik", group[number], group)
        u, _, vt = np.linalg.svd(mean)
        group = u @ vt
    return list(group)


def _generators(turns: list[Array]) -> list[Symmetry] | None:
    """Few symmetries that generate the turns (3, 3), those by the smallest angles first.

    None: they never come round, and are no group.
    """
    found: list[Symmetry] = []
    known = [np.eye(3)]
    for turn in sorted(turns[1:], key=lambda turn: round(rotation_angle(turn), 6)):
        if not _is_new(turn, known, _SAME_RAD):
            continue
        vector = Rotation.from_matrix(turn).as_rotvec()
        found.append(Symmetry("discrete", _forwards(vector), rotation_angle(turn)))
        try:
            known = discrete_turns(found)
        except ValueError:
            return None
    return found
