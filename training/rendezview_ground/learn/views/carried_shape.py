"""The shape that the craft carries: a light mesh, and its look-alikes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array, minimal_rotation
from rendezview.geometry.zbuffer import draw_from_afar
from rendezview.sensors.appearance.model.shape import SHAPE_RELIEF, Shape
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT
from rendezview_ground.learn.look_alikes import look_alikes
from rendezview_ground.learn.options import ViewGeometry
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.simplify import simplified

# Of the target's radius, as it may be simplified: a quarter of a pixel where it is drawn
_TOLERANCE_RADII = 2.0 * SHAPE_RELIEF
# Order of the sphere from whose nodes its faces are looked for, and side of these pictures. Source:
# by construction, 642 directions; twice as fine as it is drawn
_SPHERE_ORDER, _SIDE_PX = 3, 500
_SIDE_RADII = 2.1  # of these pictures. Source: by construction, all of the target


def carried_shape(mesh: Mesh, geometry: ViewGeometry, seed: int) -> Shape:
    """The shape of a mesh, about the centre of its views, without what cannot be seen."""
    light = simplified(mesh, _TOLERANCE_RADII * geometry.target_radius_m, 0)
    places_m = light.vertices_m - geometry.centre_m
    shown = _shown(places_m, light.faces, geometry.target_radius_m)
    used, faces = np.unique(light.faces[shown], return_inverse=True)
    found = look_alikes(mesh, geometry.centre_m, seed)
    return Shape(
        vertices_m=places_m[used].astype(np.float32),
        faces=faces.reshape(-1, 3).astype(np.int32),
        albedo=np.rint(light.face_albedo[shown] / ALBEDO_UNIT).astype(np.uint8),
        turns=np.array([one.turn for one in found]).reshape(-1, 3, 3),
        shifts_m=np.array([one.shift_m for one in found]).reshape(-1, 3),
        alike=np.array([one.alike for one in found]),
    )


def _shown(places_m: Array, faces: NDArray[np.int32], radius_m: float) -> NDArray[np.bool_]:
    """(F,) whether a face is seen from any direction: half of a CAD model may lie within."""
    shown = np.zeros(len(faces), dtype=np.bool_)
    scale = _SIDE_PX / (_SIDE_RADII * radius_m)
    for direction in Geodesic.of_order(_SPHERE_ORDER).nodes:
        axes = minimal_rotation(direction, np.array([0.0, 0.0, 1.0]))
        _, owner = draw_from_afar(places_m, faces, axes, scale, _SIDE_PX)
        shown[owner[owner >= 0]] = True
    return shown
