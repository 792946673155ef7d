"""Random points on the surface of a mesh."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh


def surface_sample(mesh: Mesh, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points, uniform over the surface, target frame, m."""
    return sample_with_normals(mesh, count, rng)[0]


def sample_with_normals(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (count, 3), uniform over the surface, and unit normals (count, 3), either way."""
    corners = mesh.vertices_m[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    chosen = rng.choice(len(area), size=count, p=area / area.sum())
    a, b = rng.random((2, count))
    flip = a + b > 1.0
    a, b = np.where(flip, 1.0 - a, a), np.where(flip, 1.0 - b, b)
    p = corners[chosen]
    normals = cross[chosen] / area[chosen, None]
    return p[:, 0] + a[:, None] * (p[:, 1] - p[:, 0]) + b[:, None] * (p[:, 2] - p[:, 0]), normals
