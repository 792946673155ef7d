"""A body with twelve sides that only two boxes and two stubs tell apart."""

import numpy as np
import trimesh
from tests.ground.mesh.mesh_samples import grey_mesh

from rendezview_ground.mesh.mesh import Mesh


def twelve_sides() -> Mesh:
    """A drum of radius 1 m along z; a box at its side, a stub on its top, both off the axis."""
    drum = trimesh.creation.cylinder(1.0, 1.4, sections=12)
    at_side = trimesh.creation.box((0.3, 0.36, 0.6))
    at_side.apply_translation((1.03, 0.0, 0.1))
    stub = trimesh.creation.cylinder(0.12, 0.9, sections=12)
    stub.apply_translation((0.55, 0.0, 1.1))
    foot = trimesh.creation.cone(0.4, 0.4, sections=24)
    foot.apply_transform(trimesh.transformations.rotation_matrix(np.pi, (1.0, 0.0, 0.0)))
    foot.apply_translation((0.0, 0.0, -0.7))
    return grey_mesh([drum, at_side, stub, foot])
