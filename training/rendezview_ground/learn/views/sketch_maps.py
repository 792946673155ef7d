"""The maps of an ideal sketch, from the faces that a z-buffer shows.

They are what the sketch network is taught, and what the views of a model are compared by, so both
come from here.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Int32s
from rendezview.sensors.appearance.model.sketches import (
    MAPS,
    Float32s,
    centroid,
    encoded,
    on_grid,
    smoothed,
)
from rendezview_ground.learn.options import ViewGeometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import face_normals
from rendezview_ground.render.projection import SurfaceRenderer

SAMPLES = 2  # a pixel side. Source: by construction
RANGE_RADII = 6.0  # target radii from which views are sketched. Source: middle of 3 to 13
_JUMP_RADII = 0.03  # of the target's radius: a larger step in depth is an edge
_CREASE_COSINE = 0.9  # between facets four samples apart: 26°
_BEND_COSINE = 0.95  # between facets two samples apart: a crease is sharp, a cylinder is not
_LINE_GAIN = 1.6  # a line of two samples reaches 1 in the middle. Source: by construction
_PICTURE_PX = 96  # px; width of the drawn view of a model
_BORDER_PX = 2.0  # px around the target in the picture. Source: by construction


def sketch_maps(nearness: Float32s, owner: Int32s, normals: Float32s, radius_m: float) -> Float32s:
    """(MAPS, h, w) of a z-buffer (SAMPLES h, SAMPLES w).

    Args:
        nearness: 1/z, 1/m; 0: sky.
        owner: the face there; −1: sky.
        normals: (F, 3) of ``face_normals``.
        radius_m: of the target.
    """
    shown = owner >= 0
    depth = np.where(shown, 1.0 / np.maximum(nearness, 1e-9), 0.0).astype(np.float32)
    depth[~shown] = depth.max() + 10.0 * radius_m
    normal = np.where(shown[..., None], normals[owner], 0.0).astype(np.float32)
    edge, crease = np.zeros(shown.shape, np.float32), np.zeros(shown.shape, np.float32)
    for axis in (0, 1):
        _mark_jumps(np.moveaxis(depth, axis, 0), _JUMP_RADII * radius_m, np.moveaxis(edge, axis, 0))
        _mark_creases(
            np.moveaxis(normal, axis, 0), np.moveaxis(shown, axis, 0), np.moveaxis(crease, axis, 0)
        )
    crease[edge > 0.0] = 0.0
    height, width = (side // SAMPLES for side in shown.shape)
    maps = np.empty((MAPS, height, width), np.float32)
    maps[0] = _reduced(shown.astype(np.float32))
    for k, line in ((1, edge), (2, crease)):
        soft = np.asarray(cv2.GaussianBlur(line, (0, 0), 0.5 * SAMPLES))
        maps[k] = np.minimum(_LINE_GAIN * _reduced(soft.astype(np.float32)), 1.0)
    return maps


def sketched_view(
    mesh: Mesh, geometry: ViewGeometry, direction: Array, renderer: SurfaceRenderer | None = None
) -> dict[str, npt.NDArray[Any]]:
    """One view of a model from a unit direction (3,): the fields of ``ViewSketches``."""
    range_m = RANGE_RADII * geometry.target_radius_m
    size = SAMPLES * _PICTURE_PX
    view = draw_view(mesh, geometry, direction, range_m, size, SAMPLES * _BORDER_PX, renderer)
    normals = face_normals(view.vertices, view.faces).astype(np.float32)
    maps = sketch_maps(view.nearness, view.owner, normals, geometry.target_radius_m)
    centre, extent = centroid(maps[0])
    unit_px = view.focal / SAMPLES * geometry.target_radius_m / range_m  # a target radius
    middle = 0.5 * (_PICTURE_PX - 1)
    return {
        "rotation": view.rotation.astype(np.float32),
        "maps": encoded(on_grid(smoothed(maps, extent), centre, extent)),
        "centre_radii": ((centre - middle) / unit_px).astype(np.float32),
        "size_radii": np.array(extent / unit_px, dtype=np.float32),
    }


def _mark_jumps(depth: Float32s, least_m: float, edge: Float32s) -> None:
    """Mark both sides of every step in depth along the first axis, beyond the surface's slope."""
    first, second, third = (depth[k + 1 : len(depth) - 2 + k] - depth[k : len(depth) - 3 + k]
                            for k in range(3))  # fmt: skip
    slope = np.where(np.abs(first) < np.abs(third), first, third)
    jump = np.abs(second - slope) > least_m
    edge[1:-2] = np.maximum(edge[1:-2], jump)
    edge[2:-1] = np.maximum(edge[2:-1], jump)


def _mark_creases(normal: Float32s, shown: np.ndarray, crease: Float32s) -> None:
    """Mark the middle of every sharp change of the facet along the first axis."""
    wide = np.einsum("ijk,ijk->ij", normal[:-4], normal[4:])
    near = np.einsum("ijk,ijk->ij", normal[1:-3], normal[3:-1])
    sharp = (wide < _CREASE_COSINE) & (near < _BEND_COSINE) & shown[:-4] & shown[4:]
    crease[2:-2] = np.maximum(crease[2:-2], sharp)


def _reduced(samples: Float32s) -> Float32s:
    """(h, w) means of squares of SAMPLES × SAMPLES."""
    height, width = samples.shape
    return samples.reshape(height // SAMPLES, SAMPLES, width // SAMPLES, SAMPLES).mean((1, 3))  # type: ignore[no-any-return]
