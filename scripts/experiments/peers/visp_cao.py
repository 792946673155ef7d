"""A triangle mesh as ViSP's tracker wants it: planar faces and the edges between them, a ``.cao``.

Triangles that meet flatly are one face. Faces with creases all around are written as such, and ViSP
tracks their borders. A curved surface becomes a few nearly flat patches that only hide what is
behind them (name ``smooth``); its creases, a rim, are lines of their own. Borders are
straightened alike on both sides of them, small or thin bodies are left out, and narrow faces only
hide: ViSP wants tens of edges of tens of pixels, where a mesh has thousands of two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from rendezview.training.crossings import faces_beside
from rendezview.training.mesh import Mesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

Array = npt.NDArray[np.float64]
Edge = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class CaoOptions:
    """How much of a mesh ViSP is given.

    Patches of 12° hide better: with those of 35° a few edges inside hubble's tube show through its
    wall. On the frames of docs/benchmark.md ViSP's errors are the same with either, its times a
    third longer.
    """

    crease_rad: float = np.deg2rad(28.0)  # triangles that meet at more are two faces
    bend_rad: float = np.deg2rad(35.0)  # of a patch, away from its first triangle
    least_body: float = 0.08  # longest side of a body, of the target's diameter
    least_width: float = 0.02  # its second side
    least_gap: float = 0.004  # between the borders of a face that is tracked, of the same
    straight: float = 0.002  # how far a border may be moved to be straight, of the same
    smooth_borders: bool = False  # track those of patches too: the limbs of tubes


@dataclass(frozen=True, slots=True, eq=False)
class Cao:
    """Points, faces with creases all around, faces that only hide, lines."""

    points_m: Array  # (P, 3)
    faces: list[list[int]]  # outward: counter-clockwise from outside, as the mesh winds
    smooth: list[list[int]]
    lines: list[Edge]

    @property
    def text(self) -> str:
        """The file, version 1 of the format."""
        rows = ["V1", str(len(self.points_m))]
        rows += [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in self.points_m]
        rows += [str(len(self.lines)), *(f"{a} {b}" for a, b in self.lines)]
        rows += ["0", str(len(self.faces) + len(self.smooth))]  # no faces of lines
        for corners, name in [(f, "") for f in self.faces] + [
            (f, " name=smooth") for f in self.smooth
        ]:
            rows.append(" ".join(map(str, [len(corners), *corners])) + name)
        return "\n".join([*rows, "0", "0", ""])  # no cylinders, no circles


def cao_of(mesh: Mesh, options: CaoOptions | None = None) -> Cao:
    """Faces and lines of a mesh that winds outwards."""
    options = options or CaoOptions()
    diameter_m = 2.0 * mesh.bounding_sphere[1]
    points, welded = np.unique(mesh.vertices_m, axis=0, return_inverse=True)
    triangles = welded.reshape(-1)[mesh.faces]
    kept = _large(points, triangles, options, diameter_m)
    triangles = triangles[kept]
    flat = Mesh(points, triangles.astype(np.int32), mesh.face_rgb[kept], ())
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(area, 1e-30)[:, None]
    beside = faces_beside(flat)
    patch = _patches(normals, area, beside, options)
    borders = _borders(triangles, beside, patch)
    creases = _creases(triangles, beside, normals, options)
    corner = _corners(points, borders, patch, triangles, creases, options.straight * diameter_m)
    faces: list[list[int]] = []
    smooth: list[list[int]] = []
    lines: set[Edge] = set()
    for edges in borders:
        loops = [_thinned(loop, corner) for loop in _loops(edges)]
        sharp = [[creases[_key(a, b)] for a, b in _legs(loop, corner)] for loop in _loops(edges)]
        whole = [(loop, flags) for loop, flags in zip(loops, sharp, strict=True) if len(loop) > 2]
        if not whole:
            continue
        gap = _gap([loop for loop, _ in whole], points)
        wide = gap >= options.least_gap * diameter_m
        if len(whole) == 1 and wide and (all(whole[0][1]) or options.smooth_borders):
            faces.append(whole[0][0])
            continue
        if not wide:
            continue
        smooth.append(_bridged([loop for loop, _ in whole], points))
        for loop, flags in whole:
            legs = zip(loop, [*loop[1:], loop[0]], flags, strict=True)
            lines |= {_key(a, b) for a, b, flag in legs if flag or options.smooth_borders}
    lines -= {_key(a, b) for f in faces for a, b in zip(f, [*f[1:], f[0]], strict=True)}
    return _used(points, faces, smooth, sorted(lines))


def _large(
    points: Array, triangles: npt.NDArray[np.intp], options: CaoOptions, diameter_m: float
) -> npt.NDArray[np.bool_]:
    """(F,) whether a triangle's body is long and wide enough."""
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(points),) * 2)
    body = connected_components(links, directed=False)[1][triangles[:, 0]]
    kept = np.zeros(len(triangles), dtype=bool)
    for k in np.unique(body):
        own = points[np.unique(triangles[body == k])]
        axes = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)[2]
        sides = np.sort(np.ptp(own @ axes.T, axis=0))[::-1] / diameter_m
        kept[body == k] = sides[0] >= options.least_body and sides[1] >= options.least_width
    return kept


def _patches(
    normals: Array, area: Array, beside: npt.NDArray[np.int32], options: CaoOptions
) -> npt.NDArray[np.intp]:
    """(F,) patch of each triangle, grown from the largest one that is left."""
    patch = np.full(len(normals), -1, dtype=np.intp)
    least, bent = np.cos(options.crease_rad), np.cos(options.bend_rad)
    for seed in np.argsort(-area, kind="stable"):
        if patch[seed] >= 0:
            continue
        patch[seed] = name = seed
        todo = [int(seed)]
        while todo:
            here = todo.pop()
            for there in beside[here]:
                if (
                    there >= 0
                    and patch[there] < 0
                    and normals[here] @ normals[there] > least
                    and normals[seed] @ normals[there] > bent
                ):
                    patch[there] = name
                    todo.append(int(there))
    return np.unique(patch, return_inverse=True)[1]


def _borders(
    triangles: npt.NDArray[np.intp], beside: npt.NDArray[np.int32], patch: npt.NDArray[np.intp]
) -> list[list[Edge]]:
    """Directed edges around each patch."""
    borders: list[list[Edge]] = [[] for _ in range(int(patch.max(initial=-1)) + 1)]
    for k, triangle in enumerate(triangles):
        for side in range(3):
            other = beside[k, side]
            if other < 0 or patch[other] != patch[k]:
                borders[patch[k]].append((int(triangle[side]), int(triangle[(side + 1) % 3])))
    return borders


def _creases(
    triangles: npt.NDArray[np.intp],
    beside: npt.NDArray[np.int32],
    normals: Array,
    options: CaoOptions,
) -> dict[Edge, bool]:
    """Whether an edge is a crease or the end of a surface."""
    least = np.cos(options.crease_rad)
    creases: dict[Edge, bool] = {}
    for k, triangle in enumerate(triangles):
        for side in range(3):
            key, other = _key(triangle[side], triangle[(side + 1) % 3]), beside[k, side]
            creases[key] = bool(other < 0 or normals[k] @ normals[other] <= least)
    return creases


def _corners(
    points: Array,
    borders: list[list[Edge]],
    patch: npt.NDArray[np.intp],
    triangles: npt.NDArray[np.intp],
    creases: dict[Edge, bool],
    reach_m: float,
) -> npt.NDArray[np.bool_]:
    """(P,) whether a point stays when borders are straightened.

    Where other than two borders meet, or a crease ends, a point stays; between such points those
    stay that are farther than ``reach_m`` from the straight line (Douglas and Peucker).
    """
    around: dict[int, set[int]] = {}
    for edges in borders:
        for a, b in edges:
            around.setdefault(a, set()).add(b)
            around.setdefault(b, set()).add(a)
    stays = np.zeros(len(points), dtype=bool)
    for here, others in around.items():
        kinds = {creases[_key(here, other)] for other in others}
        stays[here] = len(others) != 2 or len(kinds) > 1
    visited: set[Edge] = set()
    # chains from corner to corner, then closed ones from any of their points
    for here in [*np.flatnonzero(stays).tolist(), *around]:
        for other in sorted(around.get(here, ())):
            if _key(here, other) in visited:
                continue
            chain = [here, other]
            visited.add(_key(here, other))
            while not stays[chain[-1]] and chain[-1] != here:
                ahead = next(k for k in around[chain[-1]] if k != chain[-2])
                visited.add(_key(chain[-1], ahead))
                chain.append(ahead)
            stays[_straightened(points, chain, reach_m)] = True
    return stays


def _straightened(points: Array, chain: list[int], reach_m: float) -> list[int]:
    """Those of a chain that stay; of a closed one at least three."""
    if chain[0] == chain[-1]:
        away = np.linalg.norm(points[chain] - points[chain[0]], axis=1)
        half = int(np.argmax(away))
        first, second = chain[: half + 1], chain[half:]
        kept = _straightened(points, first, reach_m) + _straightened(points, second, reach_m)
        return kept if len(set(kept)) > 2 else chain
    start, end = points[chain[0]], points[chain[-1]]
    along = (end - start) / np.linalg.norm(end - start)
    offset = points[chain] - start
    off = np.linalg.norm(offset - np.outer(offset @ along, along), axis=1)
    worst = int(np.argmax(off))
    if off[worst] <= reach_m:
        return [chain[0], chain[-1]]
    before = _straightened(points, chain[: worst + 1], reach_m)
    return before + _straightened(points, chain[worst:], reach_m)


def _loops(edges: list[Edge]) -> list[list[int]]:
    """Closed borders of directed edges."""
    ahead: dict[int, list[int]] = {}
    for a, b in edges:
        ahead.setdefault(a, []).append(b)
    loops = []
    while ahead:
        start = next(iter(ahead))
        loop = [start]
        while loop[-1] in ahead:
            following = ahead[loop[-1]]
            loop.append(following.pop())
            if not following:
                del ahead[loop[-2]]
            if loop[-1] == start:
                break
        if loop[-1] == start:
            loops.append(loop[:-1])
    return loops


def _thinned(loop: list[int], corner: npt.NDArray[np.bool_]) -> list[int]:
    return [k for k in loop if corner[k]]


def _legs(loop: list[int], corner: npt.NDArray[np.bool_]) -> list[Edge]:
    """The first edge from each corner of a loop: it represents all up to the next corner."""
    return [(a, b) for a, b in zip(loop, [*loop[1:], loop[0]], strict=True) if corner[a]]


def _gap(loops: list[list[int]], points: Array) -> float:
    """Between the long sides of a face: twice its area over its border's length."""
    area, length = np.zeros(3), 0.0
    for loop in loops:
        corners = points[loop] - points[loops[0][0]]
        ahead = np.roll(corners, -1, axis=0)
        area += np.cross(corners, ahead).sum(axis=0)  # holes wind the other way
        length += float(np.linalg.norm(ahead - corners, axis=1).sum())
    return float(np.linalg.norm(area)) / length


def _bridged(loops: list[list[int]], points: Array) -> list[int]:
    """One border of an outer one and those of holes, with a bridge there and back to each."""
    size = [float(np.linalg.norm(np.ptp(points[loop], axis=0))) for loop in loops]
    outer = loops.pop(int(np.argmax(size)))
    for hole in loops:
        apart = np.linalg.norm(points[outer][:, None] - points[hole][None], axis=2)
        a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
        turned = hole[b:] + hole[:b]
        outer = outer[: a + 1] + turned + [turned[0]] + outer[a:]
    return outer


def _used(points: Array, faces: list[list[int]], smooth: list[list[int]], lines: list[Edge]) -> Cao:
    """With only the points that are in use."""
    named = sorted({k for face in [*faces, *smooth] for k in face} | {k for e in lines for k in e})
    number = {k: n for n, k in enumerate(named)}
    return Cao(
        points[named],
        [[number[k] for k in face] for face in faces],
        [[number[k] for k in face] for face in smooth],
        [(number[a], number[b]) for a, b in lines],
    )


def _key(a: int, b: int) -> Edge:
    return (int(a), int(b)) if a < b else (int(b), int(a))
