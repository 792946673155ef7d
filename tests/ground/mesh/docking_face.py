"""A vehicle with a docking ring and long wings, for tests that come close to it."""

from __future__ import annotations

import numpy as np
import trimesh
from tests.ground.mesh.mesh_samples import boxes, grey_mesh

from rendezview.io.target import DockingRing
from rendezview_ground.mesh.mesh import Mesh

RING = DockingRing(np.array([0.0, 0.0, 1.2]), np.array([0.0, 0.0, 1.0]), 0.6)
# Size and middle of each box, m: the bus, two wings, and four boxes of unlike sizes around the ring
_BOXES_M = (
    ((2.4, 2.2, 2.0), (0.0, 0.0, 0.0)),
    ((1.2, 11.0, 0.05), (0.0, 0.0, -0.2)),
    ((0.3, 0.2, 0.1), (0.85, 0.8, 1.05)),
    ((0.15, 0.3, 0.2), (-0.9, 0.5, 1.1)),
    ((0.25, 0.12, 0.15), (-0.3, -0.9, 1.07)),
    ((0.2, 0.1, 0.12), (0.1, 0.2, 1.06)),
)


def docking_mesh() -> Mesh:
    """The vehicle, all of one grey."""
    ring = trimesh.creation.annulus(0.52, 0.6, 0.2, sections=72)
    ring.apply_translation((0.0, 0.0, 1.1))
    return grey_mesh([ring, *boxes(_BOXES_M)])
