"""Solids the target vehicles are made of: boxes, tubes, dishes, panels, colours.

Every function returns one closed solid (`trimesh.Trimesh`, outward winding) in the
vehicle's target frame. Units: metres and radians.
No booleans: parts may overlap, each single part is watertight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Vector = Sequence[float] | Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Colour:
    """A surface: sRGB colour, and the metallic–roughness pair of a glTF material."""

    name: str
    srgb: tuple[int, int, int]
    metallic: float = 0.0
    roughness: float = 0.8


WHITE = Colour(name="white-paint", srgb=(232, 232, 228))
FOIL = Colour(name="foil-gold", srgb=(222, 164, 58), metallic=0.6, roughness=0.35)
SILVER = Colour(name="foil-silver", srgb=(206, 211, 220), metallic=0.5, roughness=0.3)
GREY = Colour(name="aluminium", srgb=(150, 154, 160), metallic=0.4, roughness=0.5)
DARK = Colour(name="dark-grey", srgb=(72, 75, 82), roughness=0.7)
BLACK = Colour(name="black", srgb=(22, 22, 25), roughness=0.9)
# Solar absorptance of cells about 0.9: they reflect a tenth.
CELL = Colour(name="solar-cell", srgb=(66, 86, 150), metallic=0.2, roughness=0.25)
YELLOW = Colour(name="handrail-yellow", srgb=(226, 190, 62), roughness=0.6)
RED = Colour(name="led-red", srgb=(236, 48, 40), roughness=0.4)
RETRO = Colour(name="retro-reflector", srgb=(250, 252, 255), metallic=0.1, roughness=0.1)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One named solid of a vehicle and its surface."""

    name: str
    mesh: trimesh.Trimesh
    colour: Colour


def _solid(vertices: ArrayLike, faces: ArrayLike) -> trimesh.Trimesh:
    """A mesh with outward winding, whichever way its faces were listed."""
    mesh = trimesh.Trimesh(np.asarray(vertices, float), np.asarray(faces, int), process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def unit(vector: Vector) -> Array:
    """`vector` scaled to length one."""
    array = np.asarray(vector, float)
    return np.asarray(array / np.linalg.norm(array))


def frame(axis: Vector, up: Vector = (0.0, 0.0, 1.0)) -> Array:
    """(3, 3) right-handed basis, columns (along, side, up): `axis` first, `up` nearly kept.

    Where `axis` is parallel to `up`, +X replaces `up`.
    """
    along = unit(axis)
    if np.linalg.norm(np.cross(np.asarray(up, float), along)) < 1e-6:
        up = (1.0, 0.0, 0.0)
    side = unit(np.cross(np.asarray(up, float), along))
    return np.column_stack([along, side, np.cross(along, side)])


def turn(axis: Vector, angle_rad: float) -> Array:
    """(3, 3) rotation by `angle_rad` about `axis`, right-handed (Rodrigues)."""
    x, y, z = unit(axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * k + (1.0 - np.cos(angle_rad)) * (k @ k))


def moved(
    mesh: trimesh.Trimesh, rotation: Array | None = None, translation: Vector = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    """`mesh` with every vertex p replaced by rotation @ p + translation."""
    rotation = np.eye(3) if rotation is None else rotation
    return _solid(mesh.vertices @ rotation.T + np.asarray(translation, float), mesh.faces)


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Several solids as one part; they may overlap and stay separate bodies."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return _solid(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.faces + start for mesh, start in zip(meshes, offsets, strict=True)]),
    )


def box(size: Vector, centre: Vector, rotation: Array | None = None) -> trimesh.Trimesh:
    """Cuboid of edge lengths `size`, turned by `rotation` about its own `centre`."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return moved(_solid(0.5 * signs * np.asarray(size, float), faces), rotation, centre)


def revolve(
    profile: ArrayLike, origin: Vector, axis: Vector, sections: int = 32, phase_rad: float = 0.0
) -> trimesh.Trimesh:
    """Solid of revolution of the closed polygon `profile`, (n, 2) rows (along, radius).

    `along` is measured from `origin` along `axis`. A radius of zero is a pole.
    """
    angles = phase_rad + 2.0 * np.pi * np.arange(sections) / sections
    vertices: list[Array] = []
    rows: list[Array] = []
    for along, radius in np.asarray(profile, float):
        count = 1 if radius == 0.0 else sections
        rows.append(np.resize(np.arange(len(vertices), len(vertices) + count), sections))
        circle = [(along, radius * np.cos(a), radius * np.sin(a)) for a in angles[:count]]
        vertices.extend(np.array(point) for point in circle)
    faces: list[tuple[int, int, int]] = []
    for near, far in zip(rows, rows[1:] + rows[:1], strict=True):
        for i in range(sections):
            j = (i + 1) % sections
            quad = ((near[i], near[j], far[j]), (near[i], far[j], far[i]))
            faces.extend(triangle for triangle in quad if len(set(triangle)) == 3)
    return moved(_solid(vertices, faces), frame(axis), origin)


def frustum(
    start: Vector, end: Vector, start_radius: float, end_radius: float, sections: int = 32
) -> trimesh.Trimesh:
    """Cone frustum between two centres; the radii are of the corners of the polygon."""
    length = float(np.linalg.norm(np.asarray(end, float) - np.asarray(start, float)))
    profile = [(0.0, 0.0), (0.0, start_radius), (length, end_radius), (length, 0.0)]
    return revolve(profile, start, np.asarray(end, float) - np.asarray(start, float), sections)


def cylinder(start: Vector, end: Vector, radius: float, sections: int = 16) -> trimesh.Trimesh:
    """Cylinder, bar or mast from `start` to `end`."""
    return frustum(start, end, radius, radius, sections)


def tube(
    origin: Vector,
    axis: Vector,
    along: tuple[float, float],
    radii: tuple[float, float],
    sections: int = 48,
) -> trimesh.Trimesh:
    """Ring or pipe: `along` = from/to along `axis`, `radii` = inner and outer."""
    (a, b), (inner, outer) = along, radii
    return revolve([(a, inner), (a, outer), (b, outer), (b, inner)], origin, axis, sections)


def patch(
    along: tuple[float, float],
    angles_rad: tuple[float, float],
    radii: tuple[float, float],
    steps: int = 8,
) -> trimesh.Trimesh:
    """Curved plate lying on a cylinder about the X axis; angle 0 is +Y, π/2 is +Z."""
    vertices = [
        (x, r * np.cos(a), r * np.sin(a))
        for a in np.linspace(*angles_rad, steps + 1)
        for x, r in (
            (along[0], radii[0]),
            (along[1], radii[0]),
            (along[1], radii[1]),
            (along[0], radii[1]),
        )
    ]
    faces = [(0, 1, 2), (0, 2, 3)]
    for i in range(steps):
        for k in range(4):
            a, b = 4 * i + k, 4 * i + (k + 1) % 4
            faces += [(a, b + 4, b), (a, a + 4, b + 4)]
    last = 4 * steps
    faces += [(last, last + 2, last + 1), (last, last + 3, last + 2)]
    return _solid(vertices, faces)


def prism(outline: ArrayLike, low: float, high: float, centre: Vector) -> trimesh.Trimesh:
    """Plate between z = low and z = high; `outline` (n, 2) is star-shaped about `centre`."""
    ring = np.asarray(outline, float)
    n = len(ring)
    vertices = [(*point, z) for z in (low, high) for point in (*ring, tuple(centre))]
    faces = []
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, j, n + 1 + j), (i, n + 1 + j, n + 1 + i)]
        faces += [(n, j, i), (2 * n + 1, n + 1 + i, n + 1 + j)]
    return _solid(vertices, faces)


def loft(sections: ArrayLike) -> trimesh.Trimesh:
    """Skin over cross-sections (S, n, 3), corner by corner, closed by a fan at each end.

    The end sections are star-shaped about their means.
    """
    rings = np.asarray(sections, float)
    count, n = rings.shape[:2]
    vertices = [*rings.reshape(-1, 3), rings[0].mean(axis=0), rings[-1].mean(axis=0)]
    first, last = count * n, count * n + 1
    faces = []
    for i in range(n):
        j = (i + 1) % n
        for k in range(0, (count - 1) * n, n):
            faces += [(k + i, k + j, k + n + j), (k + i, k + n + j, k + n + i)]
        end = (count - 1) * n
        faces += [(first, j, i), (last, end + i, end + j)]
    return _solid(vertices, faces)


def dish(
    vertex: Vector,
    axis: Vector,
    diameter: float,
    depth: float,
    thickness: float = 0.025,
    sections: int = 40,
) -> trimesh.Trimesh:
    """Paraboloid reflector: `vertex` is the deepest point of its front, `axis` looks out."""
    radii = np.linspace(0.0, 0.5 * diameter, 7)
    front = np.column_stack([depth * (radii / radii[-1]) ** 2, radii])
    back = front[::-1] - np.array([thickness, 0.0])
    return revolve(np.vstack([front, back]), vertex, axis, sections)


def handrail(start: Vector, end: Vector, out: Vector, height: float = 0.12) -> trimesh.Trimesh:
    """Rail from `start` to `end`, standing `height` off the surface along `out`."""
    first, last, lift = np.asarray(start, float), np.asarray(end, float), height * unit(out)
    sink = 0.05 * unit(out)
    return joined(
        cylinder(first - sink, first + lift, 0.018, 6),
        cylinder(last - sink, last + lift, 0.018, 6),
        cylinder(first + lift, last + lift, 0.02, 8),
    )


def solar_panel(
    name: str, centre: Vector, rotation: Array, size: tuple[float, float], grid: tuple[int, int]
) -> list[Part]:
    """Rigid panel: a 24 mm board and, on its +z side, a grid of cell blocks.

    `size` and `grid` are along the panel's own x and y; its +z carries the cells.
    """
    board = box((*size, 0.024), centre, rotation)
    pitch = np.array(size) / np.array(grid)
    blocks = []
    for i in range(grid[0]):
        for j in range(grid[1]):
            x, y = (np.array([i, j]) + 0.5) * pitch - 0.5 * np.array(size)
            at = np.asarray(centre, float) + rotation @ np.array([x, y, 0.006])
            blocks.append(box((*(pitch - 0.03), 0.02), at, rotation))
    return [Part(f"{name}-board", board, GREY), Part(f"{name}-cells", joined(*blocks), CELL)]
