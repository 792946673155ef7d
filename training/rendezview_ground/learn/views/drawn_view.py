"""A z-buffered view of the mesh from one direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import draw_parallel, draw_perspective, empty_buffers
from rendezview_ground.learn.options import ViewGeometry
from rendezview_ground.learn.views.views import look_from
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import NEAREST_M, SurfaceRenderer, Window

_LEAST_DEPTH_M = 0.02  # m, of a near face. Source: by construction, its pixels stay finite


@dataclass(frozen=True, slots=True, eq=False)
class DrawnView:
    """A square picture of the target, the view centre in its middle."""

    rotation: Array  # (3, 3) camera_from_target
    vertices: Array  # (V, 3) camera frame, m
    points: Array  # (V, 3) their pixels, and nearness in 1/m
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
    half_rad = np.arcsin(min(1.0, geometry.target_radius_m / range_m))
    if geometry.near_half_rad is not None:
        half_rad = min(half_rad, geometry.near_half_rad)
    focal = (0.5 * size_px - border_px) / np.tan(half_rad)
    middle = 0.5 * (size_px - 1)
    pose = Pose(rotation, np.array([0.0, 0.0, range_m]) - rotation @ geometry.centre_m)
    vertices, on_plane = _in_camera(
        mesh.vertices_m, pose.rotation, pose.translation_m, float(focal), middle
    )
    faces = np.array(mesh.faces, dtype=np.int32, order="C")
    if geometry.near_half_rad is not None:
        # What reaches behind the camera is beside the picture.
        behind = (vertices[faces][..., 2] < _LEAST_DEPTH_M).any(axis=1)
        faces[behind] = int(np.argmax(vertices[:, 2]))
    if renderer is None:
        nearness, owner = empty_buffers(size_px, size_px)
        if vertices[:, 2].min() > NEAREST_M:
            draw_parallel(on_plane, faces, nearness, owner)
        else:
            draw_perspective(
                vertices, faces, focal, focal, middle, middle, NEAREST_M, nearness, owner
            )
    else:
        nearness, owner = renderer.draw_surfaces(
            pose, Window(size_px, size_px, float(focal), middle, middle)
        )
    return DrawnView(rotation, vertices, on_plane, faces, float(focal), middle, nearness, owner)


@njit(cache=True, nogil=True, error_model="numpy")
def _in_camera(
    vertices: Array, rotation: Array, translation: Array, focal: float, middle: float
) -> tuple[Array, Array]:
    """Vertices in the camera frame, and (V, 3) their pixels with 1/z, of `NEAREST_M` at least."""
    inside, on_plane = np.empty_like(vertices), np.empty_like(vertices)
    for i in range(len(vertices)):
        for k in range(3):
            value = translation[k]
            for j in range(3):
                value += rotation[k, j] * vertices[i, j]
            inside[i, k] = value
        nearness = 1.0 / max(inside[i, 2], NEAREST_M)
        on_plane[i, 0] = inside[i, 0] * nearness * focal + middle
        on_plane[i, 1] = inside[i, 1] * nearness * focal + middle
        on_plane[i, 2] = nearness
    return inside, on_plane
