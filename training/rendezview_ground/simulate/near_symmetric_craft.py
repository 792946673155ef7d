"""Craft that nearly map onto themselves, for frames in which poses look alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from trimesh.creation import box, cone, cylinder

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.colours import GREY
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.random_craft import mesh_of, rotation


def twelve_sides() -> Mesh:
    """A drum of radius 1 m; two boxes, a boom and a dish tell its sides apart."""
    return _joined([
        cylinder(1.0, 1.4, sections=12),
        cylinder(0.45, 0.3, sections=24, transform=_at(0.0, 0.0, 0.85)),
        cylinder(0.08, 0.9, sections=12, transform=_at(0.55, 0.0, 1.1)),
        box((0.25, 0.3, 0.5), transform=_at(1.03, 0.0, 0.1)),
        box((0.2, 0.2, 0.3), transform=_at(-0.6, 0.82, -0.3)),
        cone(0.4, 0.4, sections=24, transform=_at(0.0, 0.0, -0.95)),
    ])  # fmt: skip


def four_panels() -> Mesh:
    """A box with a cross of panels, 5.4 m across; an antenna, a boom and a box tell its sides."""
    panels = [box((2.0, 0.9, 0.05), transform=_at(1.7, 0.0, 0.2)) for _ in range(4)]
    for k, panel in enumerate(panels):
        panel.apply_transform(rotation([0.0, 0.0, 1.0], 0.5 * np.pi * k))
    return _joined([
        box((1.2, 1.2, 1.5)),
        *panels,
        cylinder(0.35, 0.12, sections=24, transform=_at(0.3, 0.2, 0.85)),
        cylinder(0.06, 0.8, sections=12, transform=_at(-0.4, -0.35, 1.1)),
        cone(0.3, 0.5, sections=24, transform=_at(0.0, 0.0, -1.25)),
        box((0.2, 0.1, 0.6), transform=_at(0.62, 0.3, -0.1)),
    ])  # fmt: skip


def any_near_symmetric(rng: np.random.Generator) -> Mesh:
    """A random drum or box with 2 to 12 like sides or panels; small parts tell them apart."""
    sides, height = int(rng.choice([2, 3, 4, 6, 8, 12])), rng.uniform(0.6, 2.4)
    body = box((1.3, 1.3, height))
    if rng.random() < 0.5:
        body = cylinder(1.0, height, sections=max(sides, 4))
    parts = [body]
    if sides <= 4 or rng.random() < 0.4:
        length, chord, up = rng.uniform(0.8, 2.2), rng.uniform(0.4, 1.0), rng.uniform(-0.4, 0.4)
        tilt = 0.5 * np.pi * rng.integers(2)
        for k in range(min(sides, 6)):
            panel = box((length, chord, 0.05))
            panel.apply_transform(rotation([1.0, 0.0, 0.0], tilt))
            panel.apply_translation((1.0 + 0.5 * length, 0.0, up * height))
            panel.apply_transform(rotation([0.0, 0.0, 1.0], 2.0 * np.pi * k / min(sides, 6)))
            parts.append(panel)
    for _ in range(int(rng.integers(1, 4))):
        size, angle = rng.uniform(0.12, 0.45, 3), rng.uniform(0.0, 2.0 * np.pi)
        up = rng.uniform(-0.45, 0.45) * height
        parts.append(box(size, transform=_at(np.cos(angle), np.sin(angle), up)))
    if rng.random() < 0.6:
        parts.append(cone(0.4, 0.4, sections=24, transform=_at(0.0, 0.0, -0.5 * height - 0.35)))
    if rng.random() < 0.6:
        x, y = rng.uniform(-0.6, 0.6, 2)
        length = rng.uniform(0.4, 1.0)
        mast = cylinder(0.06, length, sections=12, transform=_at(x, y, 0.5 * height + 0.4))
        parts.append(mast)
    return _joined(parts)


CRAFT: dict[str, Callable[[], Mesh]] = {"twelve-sides": twelve_sides, "four-panels": four_panels}


def _at(x: float, y: float, z: float) -> Array:
    matrix: Any = trimesh.transformations.translation_matrix  # not typed
    return np.asarray(matrix([x, y, z]))


def _joined(bodies: list[trimesh.Trimesh]) -> Mesh:
    return mesh_of([(body, np.full(len(body.faces), GREY)) for body in bodies])
