"""Points spread over the surface of a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh

_SAMPLES = 20_000  # points on the chosen faces. Source: 1 % of a part's size between neighbours


def points_on(mesh: Mesh, chosen: npt.NDArray[np.bool_], seed: int = 0) -> Array:
    """(N, 3) points on the chosen faces (F,), evenly by area, and their corners."""
    corners = mesh.vertices_m[mesh.faces[chosen]]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    rng = np.random.default_rng(seed)
    face = rng.choice(len(corners), size=_SAMPLES, p=area / area.sum())
    a, b = rng.random(_SAMPLES), rng.random(_SAMPLES)
    beyond = a + b > 1.0
    a[beyond], b[beyond] = 1.0 - a[beyond], 1.0 - b[beyond]
    origin, first, second = corners[face, 0], corners[face, 1], corners[face, 2]
    spread = origin + a[:, None] * (first - origin) + b[:, None] * (second - origin)
    return np.vstack([spread, corners.reshape(-1, 3)])
