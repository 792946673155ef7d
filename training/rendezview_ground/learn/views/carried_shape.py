"""The shape that the craft carries: a light mesh, and its look-alikes."""

from __future__ import annotations

import numpy as np

from rendezview.sensors.appearance.model.shape import SHAPE_RELIEF, Shape
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT
from rendezview_ground.learn.look_alikes import look_alikes
from rendezview_ground.learn.options import ViewGeometry
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.simplify import simplified

# Faces; a smaller mesh is carried as it is. Source: drawing takes 2 ms with so many
_MANY_FACES = 8000
# Of the target's radius, as it may be simplified: a quarter of a pixel where it is drawn
_TOLERANCE_RADII = 2.0 * SHAPE_RELIEF


def carried_shape(mesh: Mesh, geometry: ViewGeometry, seed: int) -> Shape:
    """The shape of a mesh, about the centre of its views."""
    light = simplified(mesh, _TOLERANCE_RADII * geometry.target_radius_m, _MANY_FACES)
    used, faces = np.unique(light.faces, return_inverse=True)
    vertices = light.vertices_m[used] - geometry.centre_m
    found = look_alikes(mesh, geometry.centre_m, seed)
    return Shape(
        vertices_m=vertices.astype(np.float32),
        faces=faces.reshape(-1, 3).astype(np.int32),
        albedo=np.rint(light.face_albedo / ALBEDO_UNIT).astype(np.uint8),
        turns=np.array([one.turn for one in found]).reshape(-1, 3, 3),
        shifts_m=np.array([one.shift_m for one in found]).reshape(-1, 3),
        alike=np.array([one.alike for one in found]),
    )
