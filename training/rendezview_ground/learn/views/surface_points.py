"""Points on the surface of the target, and the directions from which each is visible."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Int32s
from rendezview.sensors.appearance.model.contours import DIRECTION_UNIT, POINT_UNIT
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT, Surface
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.triangles import random_points, twice_areas
from rendezview_ground.render.crossings import face_normals
from rendezview_ground.render.projection import SurfaceRenderer
from rendezview_ground.render.shown_faces import bits_of

SURFACE_ORDER = 3  # of the sphere of directions: 642, independent of the order of the trees
_CANDIDATES = 8  # candidates per kept point: much of a mesh is visible from nowhere
_AFAR_RADII = 100.0  # target radii; perspective is negligible from there
_BORDER_PX = 4.0  # px around the target in the picture
_STREAM = 6  # of random numbers


def candidate_points(
    mesh: Mesh, geometry: ViewGeometry, options: TrainingOptions
) -> tuple[Array, npt.NDArray[np.int32]]:
    """Random points over the surface, fewer where it is less trusted.

    Returns:
        (N, 3) from the view centre, and faces (N,).
    """
    rng = np.random.default_rng([options.seed, _STREAM])
    corners = (mesh.vertices_m - geometry.centre_m)[mesh.faces]
    area = twice_areas(corners)
    if mesh.face_trust is not None:
        area *= mesh.face_trust
    points, face = random_points(corners, area, _CANDIDATES * options.surface_points, rng)
    return points, face.astype(np.int32)


def visible_points(
    mesh: Mesh,
    geometry: ViewGeometry,
    points: Array,
    faces: npt.NDArray[np.int32],
    direction: Array,
    options: TrainingOptions,
    renderer: SurfaceRenderer | None = None,
) -> tuple[npt.NDArray[np.uint8], Int32s]:
    """(N / 8,) bits, lowest first: which of the points are visible from a distant camera.

    And (H, W) the face that each pixel of its picture shows, −1 in the sky.
    """
    range_m = _AFAR_RADII * geometry.target_radius_m
    size = options.contour_resolution_px
    view = draw_view(mesh, geometry, direction, range_m, size, _BORDER_PX, renderer)
    places = points @ view.rotation.T + np.array([0.0, 0.0, range_m])
    visible = _look_up(places, faces, view.focal, view.middle, view.owner)
    return np.packbits(visible, bitorder="little"), view.owner


def shown_from_near(
    mesh: Mesh, geometry: ViewGeometry, direction: Array, options: TrainingOptions
) -> npt.NDArray[np.uint8]:
    """(F / 8,) bits, lowest first: which faces a camera at the nearest range sees."""
    radii = min(options.range_radii[0], *options.contour_radii)
    range_m = radii * geometry.sphere_radius_m
    view = draw_view(mesh, geometry, direction, range_m, options.contour_resolution_px, _BORDER_PX)
    return bits_of(view.owner, len(mesh.faces))


def chosen_surface(
    mesh: Mesh,
    geometry: ViewGeometry,
    points: Array,
    faces: npt.NDArray[np.int32],
    visible: npt.NDArray[np.uint8],
    options: TrainingOptions,
) -> Surface:
    """The first of the points that are visible from anywhere.

    Args:
        visible: (S, N / 8) of ``visible_points``, for S directions.
    """
    bits = np.unpackbits(visible, axis=1, count=len(points), bitorder="little")
    kept = np.flatnonzero(bits.any(axis=0))[: options.surface_points]
    normals = face_normals(mesh.vertices_m, np.ascontiguousarray(mesh.faces, dtype=np.int32))
    place = points[kept] / (geometry.target_radius_m * POINT_UNIT)
    return Surface(
        point=np.rint(place).astype(np.int16),
        normal=np.rint(normals[faces[kept]] / DIRECTION_UNIT).astype(np.int8),
        albedo=np.rint(mesh.face_albedo[faces[kept]] / ALBEDO_UNIT).astype(np.uint8),
        seen=np.packbits(bits[:, kept], axis=1, bitorder="little"),
    )


def _look_up(
    places: Array, faces: Int32s, focal: float, middle: float, owner: Int32s
) -> npt.NDArray[np.bool_]:
    """(N,) a point is visible if its face owns its pixel or one of the eight around it."""
    column, row = (places[:, :2] / places[:, 2:] * focal + middle + 0.5).astype(np.int64).T
    around = [owner[row + i, column + j] == faces for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return np.asarray(np.any(around, axis=0))
