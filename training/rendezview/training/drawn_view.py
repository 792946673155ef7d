"""A z-buffered view of the mesh from one direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.training.mesh import Mesh
from rendezview.training.options import ViewGeometry
from rendezview.training.projection import NEAREST_M, SurfaceRenderer, Window
from rendezview.training.views import look_from
from rendezview.training.zbuffer import draw_parallel, draw_perspective, empty_buffers

_LEAST_DEPTH_M = 0.02  # m, of a near face. Source: by construction, its pixels stay finite


@dataclass(frozen=True, slots=True, eq=False)
class DrawnView:
    """A square picture of the target, the view centre in its middle."""

    rotation: Array  # (3, 3) camera_from_target
    vertices: Array  # (V, 3) camera frame, m
    points: Array  # (V, 2) their pixels
    faces: npt.NDArray[np.int32]  # (F, 3)
    focal: float  # px
    middle: float  # px, of both axes
    nearness: npt.NDArray[np.float32]  # (size, size) 1/m; 0: sky
    owner: npt.NDArray[np.int32]  # (size, size) face; -1: sky


def draw_view(
    mesh: Mesh,
    geometry: ViewGeometry,
    direction: Array,
    range_m: float,
    size_px: int,
    border_px: float,
    renderer: SurfaceRenderer | None = None,
) -> DrawnView:
    """Draw the target from a unit direction (3,); its sphere ends ``border_px`` from the border.

    Args:
        renderer: of the same mesh; ``None``: the z-buffer of this package.
    """
    rotation = look_from(direction)
    vertices = (mesh.vertices_m - geometry.centre_m) @ rotation.T + np.array([0.0, 0.0, range_m])
    half_rad = np.arcsin(min(1.0, geometry.target_radius_m / range_m))
    if geometry.near_half_rad is not None:
        half_rad = min(half_rad, geometry.near_half_rad)
    focal = (0.5 * size_px - border_px) / np.tan(half_rad)
    middle = 0.5 * (size_px - 1)
    faces = np.array(mesh.faces, dtype=np.int32, order="C")
    if geometry.near_half_rad is not None:
        # What reaches behind the camera is beside the picture.
        behind = (vertices[faces][..., 2] < _LEAST_DEPTH_M).any(axis=1)
        faces[behind] = int(np.argmax(vertices[:, 2]))
    points = vertices[:, :2] / np.maximum(vertices[:, 2:], NEAREST_M) * focal + middle
    if renderer is None:
        nearness, owner = empty_buffers(size_px, size_px)
        if vertices[:, 2].min() > NEAREST_M:
            on_plane = np.column_stack([points, 1.0 / vertices[:, 2]])
            draw_parallel(on_plane, faces, nearness, owner)
        else:
            draw_perspective(
                vertices, faces, focal, focal, middle, middle, NEAREST_M, nearness, owner
            )
    else:
        pose = Pose(rotation, np.array([0.0, 0.0, range_m]) - rotation @ geometry.centre_m)
        nearness, owner = renderer.draw_surfaces(
            pose, Window(size_px, size_px, float(focal), middle, middle)
        )
    return DrawnView(rotation, vertices, points, faces, float(focal), middle, nearness, owner)
