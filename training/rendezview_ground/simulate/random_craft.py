"""Random spacecraft: bodies with panels, dishes and booms, or compact ones with cells and fittings.

A network trained on them knows spacecraft in general and none in particular.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh

Solid = tuple[trimesh.Trimesh, Array]  # and the albedo of its faces (F,)

# White paint and foil, grey metal, black blankets: ranges of albedo, and their shares.
_PAINTS = ((0.6, 0.95), (0.25, 0.6), (0.02, 0.2))
_PAINT_SHARES = (0.45, 0.35, 0.2)


def random_craft(rng: np.random.Generator) -> Mesh:
    """One craft of a few metres: one to three bodies along an axis, with attached parts."""
    solids: list[Solid] = []
    length = 0.0
    for _ in range(int(rng.integers(1, 4))):
        height = float(rng.uniform(0.3, 1.6))
        solid = _body(rng, height)
        solid[0].apply_translation([0.0, 0.0, length + 0.5 * height])
        solids.append(solid)
        length += height
    width = float(np.ptp(np.vstack([m.vertices for m, _ in solids])[:, :2], axis=0).max())
    pairs = int(rng.integers(0, 4))
    for k in range(pairs):
        both = rng.random() < 0.85
        panel = _panel(rng, width)
        turn = rng.uniform(0.0, np.pi)
        place = rng.uniform(0.1, 0.9) * length
        azimuth = rng.uniform(0.0, np.pi) if k else 0.0
        for side in (0.0, np.pi)[: 2 if both else 1]:
            mesh = panel[0].copy()
            mesh.apply_transform(rotation([1.0, 0.0, 0.0], turn))
            mesh.apply_transform(rotation([0.0, 0.0, 1.0], azimuth + side))
            mesh.apply_translation([0.0, 0.0, place])
            solids.append((mesh, panel[1]))
    for _ in range(int(rng.integers(0, 4))):
        solids.append(_fixed(rng, _dish(rng, width), width, length))
    for _ in range(int(rng.integers(0, 5))):
        solids.append(_fixed(rng, _boom(rng, width), width, length))
    for _ in range(int(rng.integers(0, 9))):
        solids.append(_fixed(rng, _box(rng, 0.25 * width), width, length))
    return mesh_of(solids)


def compact_craft(rng: np.random.Generator) -> Mesh:
    """One small satellite: a body, with a lid and wings of cells, rods, fittings and bars."""
    kind = rng.random()
    size = np.array([*rng.uniform(0.5, 1.3, 2), rng.uniform(0.25, 1.6)])
    if kind < 0.75:
        body = trimesh.creation.box(size)
    else:
        sections = int(rng.choice([5, 6, 8, 8, 32]))
        body = trimesh.creation.cylinder(0.5 * max(size[:2]), size[2], sections=sections)
    solids = [painted_sides(rng, body)]
    if rng.random() < 0.3:  # a step
        shares = [rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.9), rng.uniform(0.1, 0.6)]
        step = trimesh.creation.box(size * shares)
        step.apply_translation([0.0, 0.0, 0.55 * size[2] * rng.choice([-1, 1])])
        solids.append(painted_sides(rng, step))
    if rng.random() < 0.6:
        solids.append(_lid(rng, size))
    if rng.random() < 0.35:
        solids += _wings(rng, size)
    solids += [_rod(rng, size) for _ in range(int(rng.integers(0, 7)))]
    solids += [_fitting(rng, size) for _ in range(int(rng.integers(0, 14)))]
    solids += [_bar(rng, size) for _ in range(int(rng.integers(0, 5)))]
    return mesh_of(solids)


def any_craft(rng: np.random.Generator) -> Mesh:
    """A craft of either kind."""
    return random_craft(rng) if rng.random() < 0.4 else compact_craft(rng)


def mesh_of(solids: list[Solid]) -> Mesh:
    """One grey mesh of all solids."""
    whole, albedo = joined(solids)
    rgb = np.repeat(np.clip(albedo, 0.0, 1.0).astype(np.float32)[:, None], 3, axis=1)
    vertices = np.asarray(whole.vertices, dtype=np.float64)
    return Mesh(vertices, np.asarray(whole.faces, dtype=np.int32), rgb, ())


def joined(solids: list[Solid]) -> Solid:
    """One solid of all."""
    mesh: Any = trimesh.util.concatenate([mesh for mesh, _ in solids])
    return mesh, np.concatenate([albedo for _, albedo in solids])


def rotation(axis: list[float], angle_rad: float) -> Array:
    """(4, 4) of a turn about an axis through the origin."""
    matrix: Any = trimesh.transformations.rotation_matrix  # not typed
    return np.asarray(matrix(angle_rad, axis))


def _albedo(rng: np.random.Generator) -> float:
    low, high = _PAINTS[rng.choice(3, p=_PAINT_SHARES)]
    return float(rng.uniform(low, high))


def one_paint(rng: np.random.Generator, mesh: trimesh.Trimesh) -> Solid:
    """All faces of the same paint."""
    return mesh, np.full(len(mesh.faces), _albedo(rng))


def painted_sides(rng: np.random.Generator, mesh: trimesh.Trimesh) -> Solid:
    """Every side of another paint."""
    _, side = np.unique(np.round(mesh.face_normals, 1), axis=0, return_inverse=True)
    paints = np.array([_albedo(rng) for _ in range(side.max() + 1)])
    return mesh, paints[side.ravel()]


def _painted(rng: np.random.Generator, mesh: trimesh.Trimesh) -> Solid:
    """One paint, or one for each side."""
    faces = len(mesh.faces)
    albedo = np.full(faces, _albedo(rng))
    if rng.random() < 0.5:
        normals = np.round(mesh.face_normals, 2)
        _, side = np.unique(normals, axis=0, return_inverse=True)
        paints = np.array([_albedo(rng) for _ in range(4)])
        albedo = paints[side.ravel() % 4]
    elif rng.random() < 0.4:
        albedo = albedo * rng.uniform(0.6, 1.1, faces)
    return mesh, albedo


def _body(rng: np.random.Generator, height: float) -> Solid:
    kind = rng.integers(4)
    if kind == 0:
        mesh = trimesh.creation.box([*rng.uniform(0.4, 1.6, 2), height])
    elif kind == 1:
        mesh = trimesh.creation.cylinder(rng.uniform(0.25, 0.8), height,
                                         sections=int(rng.choice([6, 8, 24, 48])))  # fmt: skip
    elif kind == 2:
        mesh = trimesh.creation.cone(rng.uniform(0.3, 0.8), height, sections=32)
        mesh.apply_translation([0.0, 0.0, -0.5 * height])
    else:
        mesh = trimesh.creation.icosphere(3, 0.5 * height)
    while len(mesh.faces) < 200 and rng.random() < 0.6:
        mesh = mesh.subdivide()
    return _painted(rng, mesh)


def _panel(rng: np.random.Generator, width: float) -> Solid:
    """A solar wing in the xy plane, along x from its yoke: a grid of dark or bright cells."""
    length, chord = rng.uniform(0.5, 3.0) * width, rng.uniform(0.2, 1.2) * width
    gap = width * rng.uniform(0.3, 0.8)
    rows, columns = int(rng.integers(1, 6)), int(rng.integers(1, 12))
    cell, line = rng.uniform(0.02, 0.25), rng.uniform(0.05, 0.6)
    if rng.random() < 0.3:
        cell = _albedo(rng)  # a back side or a radiator
    share = rng.uniform(0.0, 0.15)
    taper = rng.uniform(0.3, 1.0) if rng.random() < 0.2 else 1.0
    back = trimesh.creation.box([length, chord, 0.02 * width])
    parts: list[Solid] = [(back, np.full(len(back.faces), line))]
    for i in range(columns):
        for j in range(rows):
            size = [length / columns * (1.0 - share), chord / rows * (1.0 - share), 0.024 * width]
            box = trimesh.creation.box(size)
            box.apply_translation(
                [length * ((i + 0.5) / columns - 0.5), chord * ((j + 0.5) / rows - 0.5), 0.0]
            )
            paint = cell * rng.uniform(0.8, 1.2) * np.ones(len(box.faces))
            if rng.random() < 0.7:  # the back side differs
                paint[box.face_normals[:, 2] < -0.5] = line
            parts.append((box, paint))
    mesh, albedo = joined(parts)
    mesh.vertices[:, 1] *= 1.0 - (1.0 - taper) * (mesh.vertices[:, 0] / length + 0.5)
    mesh.apply_translation([gap + 0.5 * length, 0.0, 0.0])
    yoke = trimesh.creation.box([gap, 0.05 * width, 0.05 * width])
    yoke.apply_translation([0.5 * gap, 0.0, 0.0])
    return joined([(mesh, albedo), (yoke, np.full(len(yoke.faces), _albedo(rng)))])


def _dish(rng: np.random.Generator, width: float) -> Solid:
    radius = rng.uniform(0.1, 0.6) * width
    mesh = trimesh.creation.cone(radius, rng.uniform(0.2, 0.8) * radius, sections=32)
    return _painted(rng, mesh)


def _boom(rng: np.random.Generator, width: float) -> Solid:
    length = rng.uniform(0.3, 2.5) * width
    mesh = trimesh.creation.cylinder(rng.uniform(0.008, 0.05) * width, length, sections=8)
    mesh.apply_translation([0.0, 0.0, 0.5 * length])
    solid = _painted(rng, mesh)
    if rng.random() < 0.5:
        tip = _box(rng, 0.2 * width)
        tip[0].apply_translation([0.0, 0.0, length])
        return joined([solid, tip])
    return solid


def _box(rng: np.random.Generator, size: float) -> Solid:
    return _painted(rng, trimesh.creation.box(rng.uniform(0.2, 1.0, 3) * size))


def _fixed(rng: np.random.Generator, solid: Solid, width: float, length: float) -> Solid:
    """Rotate a solid, mostly upright or across, and place it on a body's surface."""
    mesh, albedo = solid
    if rng.random() < 0.6:
        upright = rng.choice([0.0, 0.5, 1.0]) * np.pi
        turn = rotation([0.0, 0.0, 1.0], rng.uniform(0.0, 2.0 * np.pi))
        turn = turn @ rotation([0.0, 1.0, 0.0], upright)
    else:
        turn = np.asarray(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    mesh.apply_transform(turn)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    out = 0.45 * width * (1.0 if rng.random() < 0.7 else rng.random())
    mesh.apply_translation([out * np.cos(angle), out * np.sin(angle), rng.uniform(0.0, length)])
    return mesh, albedo


def _cells(rng: np.random.Generator, length: float, width: float, thickness: float) -> Solid:
    """A plate in the xy plane with a grid of cells on its upper side, dark or bright."""
    rows, columns = int(rng.integers(2, 14)), int(rng.integers(2, 14))
    share = rng.uniform(0.03, 0.15)
    if rng.random() < 0.8:
        cell, line = rng.uniform(0.01, 0.1), rng.uniform(0.05, 0.8)
    else:
        cell, line = rng.uniform(0.3, 0.9), rng.uniform(0.02, 0.4)
    plate = trimesh.creation.box([length, width, thickness])
    paint = line if rng.random() < 0.5 else _albedo(rng)
    parts: list[Solid] = [(plate, np.full(len(plate.faces), paint))]
    frame = 1.0 - 2.0 * rng.uniform(0.0, 0.06)
    pitch = np.array([length * frame / columns, width * frame / rows, thickness])
    for i in range(columns):
        for j in range(rows):
            box = trimesh.creation.box(pitch * [1.0 - share, 1.0 - share, 1.04])
            place = [i + 0.5 - 0.5 * columns, j + 0.5 - 0.5 * rows, 0.03]
            box.apply_translation(pitch * place)
            parts.append((box, np.full(len(box.faces), cell * rng.uniform(0.85, 1.15))))
    return joined(parts)


def _lid(rng: np.random.Generator, size: Array) -> Solid:
    """A plate of cells on top of a body, mostly larger than it, sometimes on stand-offs."""
    length, width = size[0] * rng.uniform(0.9, 1.7), size[1] * rng.uniform(0.9, 1.7)
    thickness = rng.uniform(0.01, 0.06)
    mesh, albedo = _cells(rng, length, width, thickness)
    aside = [rng.uniform(-0.2, 0.2) * size[0], rng.uniform(-0.2, 0.2) * size[1]]
    gap = rng.uniform(0.0, 0.1) * (rng.random() < 0.4)
    mesh.apply_translation([*aside, 0.5 * size[2] + 0.5 * thickness + gap])
    return mesh, albedo


def _wings(rng: np.random.Generator, size: Array) -> list[Solid]:
    """One or two plates of cells beside a body, with their yokes."""
    length, width = rng.uniform(0.5, 2.2), rng.uniform(0.4, 1.0)
    plate, albedo = _cells(rng, length, width, 0.03)
    gap = rng.uniform(0.02, 0.4)
    turn = rng.uniform(0.0, np.pi)
    both = rng.random() < 0.8
    solids: list[Solid] = []
    for side in (0.0, np.pi)[: 2 if both else 1]:
        mesh = plate.copy()
        mesh.apply_transform(rotation([1.0, 0.0, 0.0], turn))
        mesh.apply_translation([0.5 * size[0] + gap + 0.5 * length, 0.0, 0.0])
        yoke = trimesh.creation.box([gap + 0.05, 0.05, 0.05])
        yoke.apply_translation([0.5 * (size[0] + gap), 0.0, 0.0])
        for part in (mesh, yoke):
            part.apply_transform(rotation([0.0, 0.0, 1.0], side))
        solids += [(mesh, albedo), one_paint(rng, yoke)]
    return solids


def _rod(rng: np.random.Generator, size: Array) -> Solid:
    """A rod or whip antenna from near a corner of a body."""
    radius, length = rng.uniform(0.004, 0.05), rng.uniform(0.15, 1.1)
    mesh = trimesh.creation.cylinder(radius, length, sections=8)
    mesh.apply_translation([0.0, 0.0, 0.5 * length])
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    if rng.random() < 0.5:
        direction = np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
    align: Any = trimesh.geometry.align_vectors  # not typed
    mesh.apply_transform(align([0.0, 0.0, 1.0], direction))
    mesh.apply_translation(0.5 * size * rng.choice([-1, 1], 3) * rng.uniform(0.6, 1.0, 3))
    return one_paint(rng, mesh)


def _fitting(rng: np.random.Generator, size: Array) -> Solid:
    """A box, cylinder or ball on a side of a body."""
    axis, sign = rng.integers(3), rng.choice([-1, 1])
    extent = rng.uniform(0.03, 0.35, 3) * size
    extent[axis] *= rng.uniform(0.1, 1.0)
    kind = rng.random()
    if kind < 0.6:
        mesh = trimesh.creation.box(extent)
    elif kind < 0.8:
        mesh = trimesh.creation.cylinder(0.5 * extent.mean(), extent.mean(), sections=16)
    else:
        mesh = trimesh.creation.icosphere(2, 0.5 * extent.mean())
    place = rng.uniform(-0.5, 0.5, 3) * size
    place[axis] = sign * (0.5 * size[axis] + 0.4 * extent[axis])
    mesh.apply_translation(place)
    return painted_sides(rng, mesh) if rng.random() < 0.5 else one_paint(rng, mesh)


def _bar(rng: np.random.Generator, size: Array) -> Solid:
    """A thin bar along a side of a body, a little above it."""
    ends = rng.uniform(-0.55, 0.55, (2, 3)) * size
    axis = rng.integers(3)
    ends[:, axis] = rng.choice([-1, 1]) * 0.5 * size[axis] * rng.uniform(1.02, 1.2)
    radius = rng.uniform(0.005, 0.02)
    return one_paint(rng, trimesh.creation.cylinder(radius, segment=ends, sections=6))
