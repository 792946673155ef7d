"""Two craft that nearly map onto themselves, for frames in which poses look alike."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.creation import box, cone, cylinder

from rendezview_ground.mesh.colours import GREY
from rendezview_ground.mesh.mesh import Mesh


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
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", 90.0 * k, degrees=True).as_matrix()
        panel.apply_transform(turn)
    return _joined([
        box((1.2, 1.2, 1.5)),
        *panels,
        cylinder(0.35, 0.12, sections=24, transform=_at(0.3, 0.2, 0.85)),
        cylinder(0.06, 0.8, sections=12, transform=_at(-0.4, -0.35, 1.1)),
        cone(0.3, 0.5, sections=24, transform=_at(0.0, 0.0, -1.25)),
        box((0.2, 0.1, 0.6), transform=_at(0.62, 0.3, -0.1)),
    ])  # fmt: skip


CRAFT: dict[str, Callable[[], Mesh]] = {"twelve-sides": twelve_sides, "four-panels": four_panels}


def _at(x: float, y: float, z: float) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, 3] = x, y, z
    return transform


def _joined(bodies: list[trimesh.Trimesh]) -> Mesh:
    whole = trimesh.util.concatenate(bodies)
    assert isinstance(whole, trimesh.Trimesh)
    rgb = np.full((len(whole.faces), 3), GREY, np.float32)
    return Mesh(np.array(whole.vertices), np.array(whole.faces, np.int32), rgb, ())
