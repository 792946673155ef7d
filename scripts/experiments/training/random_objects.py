"""Random everyday objects: boxes, bricks, bottles, cans, and things put together from them.

They are as large as craft, since a picture has no scale. Source of all numbers: by construction of
the training set of the sketch network.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.random_craft import Solid, mesh_of, one_paint, painted_sides


def random_object(rng: np.random.Generator) -> Mesh:
    """One object of about a metre."""
    kind = rng.choice(5, p=(0.35, 0.2, 0.2, 0.1, 0.15))
    if kind == 0:
        return mesh_of([_box(rng)])
    if kind == 1:
        return mesh_of(_bricks(rng))
    if kind == 2:
        return mesh_of([_turned(rng)])
    if kind == 3:
        return mesh_of([_simple(rng)])
    return mesh_of(_assembly(rng))


def _box(rng: np.random.Generator) -> Solid:
    """A cube, a carton or a book."""
    extents = np.ones(3) if rng.random() < 0.25 else np.exp(rng.uniform(-1.6, 0.0, 3))
    box = trimesh.creation.box(extents)
    return one_paint(rng, box) if rng.random() < 0.5 else painted_sides(rng, box)


def _bricks(rng: np.random.Generator) -> list[Solid]:
    """Building bricks with studs, stacked on a grid; a stud is 0.6 of its pitch wide."""
    solids: list[Solid] = []
    height = rng.uniform(0.4, 1.4)
    taken = np.zeros((8, 8))  # height of the stack at each place
    for _ in range(int(rng.integers(1, 6))):
        columns, rows = int(rng.choice([2, 3, 4, 6])), int(rng.choice([1, 2, 2, 4]))
        if rng.random() < 0.5:
            columns, rows = rows, columns
        x, y = int(rng.integers(0, 9 - columns)), int(rng.integers(0, 9 - rows))
        under = taken[x : x + columns, y : y + rows].max()
        body = trimesh.creation.box([columns, rows, height])
        body.apply_translation([x + 0.5 * columns, y + 0.5 * rows, under + 0.5 * height])
        parts = [body]
        for i in range(columns):
            for j in range(rows):
                stud = trimesh.creation.cylinder(0.3, 0.2, sections=16)
                stud.apply_translation([x + i + 0.5, y + j + 0.5, under + height + 0.1])
                parts.append(stud)
        taken[x : x + columns, y : y + rows] = under + height
        whole: Any = trimesh.util.concatenate(parts)
        solids.append(one_paint(rng, whole))
    return solids


def _turned(rng: np.random.Generator) -> Solid:
    """A bottle, a can, a cup or a vase: a profile turned about an axis."""
    heights = np.sort(rng.uniform(0.0, 1.0, int(rng.integers(1, 5))))
    radii = rng.uniform(0.1, 0.45) * np.exp(rng.uniform(-0.9, 0.3, len(heights) + 2))
    if rng.random() < 0.5:  # straight up to the neck
        radii[: len(radii) // 2 + 1] = radii.max()
    profile = np.column_stack([radii, [0.0, *heights, 1.0]])
    profile = np.vstack([[0.0, 0.0], np.repeat(profile, 1, axis=0), [0.0, 1.0]])
    mesh: Any = trimesh.creation.revolve(profile, sections=int(rng.choice([24, 40])))
    bands = [1.0] if rng.random() < 0.5 else rng.uniform(0.2, 1.0, 6)
    height = mesh.triangles_center[:, 2]
    solid, albedo = one_paint(rng, mesh)
    return solid, albedo * np.asarray(bands)[(height * 5.99).astype(int) % len(bands)]


def _simple(rng: np.random.Generator) -> Solid:
    """A ball, a cone, a prism or a ring."""
    kind = rng.integers(4)
    mesh: Any
    if kind == 0:
        mesh = trimesh.creation.icosphere(3, 0.5)
    elif kind == 1:
        mesh = trimesh.creation.cone(rng.uniform(0.2, 0.6), 1.0, sections=32)
    elif kind == 2:
        sections = int(rng.choice([3, 5, 6, 8]))
        mesh = trimesh.creation.cylinder(rng.uniform(0.2, 0.6), 1.0, sections=sections)
        return painted_sides(rng, mesh)
    else:
        mesh = trimesh.creation.torus(0.5, rng.uniform(0.05, 0.25))
    mesh.apply_scale([1.0, rng.uniform(0.6, 1.0), 1.0])
    return one_paint(rng, mesh)


def _assembly(rng: np.random.Generator) -> list[Solid]:
    """A piece of furniture, a tool or a machine: boxes and cylinders that touch."""
    solids: list[Solid] = []
    centre, extents = np.zeros(3), np.exp(rng.uniform(-1.2, 0.0, 3))
    for _ in range(int(rng.integers(2, 8))):
        mesh: Any = trimesh.creation.box(extents)
        if rng.random() < 0.3:
            mesh = trimesh.creation.cylinder(0.5 * extents[0], extents[2], sections=24)
        mesh.apply_translation(centre)
        solids.append(painted_sides(rng, mesh) if rng.random() < 0.4 else one_paint(rng, mesh))
        axis, sign = rng.integers(3), rng.choice([-1.0, 1.0])
        following = np.exp(rng.uniform(-2.0, 0.0, 3))
        shift = rng.uniform(-0.5, 0.5, 3) * extents
        shift[axis] = sign * 0.49 * (extents[axis] + following[axis])
        centre, extents = centre + shift, following
    return solids
