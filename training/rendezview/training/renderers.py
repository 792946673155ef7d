"""Silhouettes of a mesh: our scanlines in numba, their numpy twin, and pyrender.

All three turn on the pixels whose centre a triangle covers, and cull nothing, because
the winding of real CAD files is unreliable.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.training.mesh import Mesh

Mask = npt.NDArray[np.uint8]
NEAREST_M = 1e-3  # nothing of the target may come closer to the plane of the camera


@dataclass(frozen=True, slots=True)
class Window:
    """The part of an undistorted picture plane that is drawn."""

    width: int
    height: int
    focal_px: float
    cx: float  # the boresight, in pixels from the centre of the top-left pixel
    cy: float

    def supersampled(self, factor: int) -> Window:
        """The same part with each pixel split into ``factor × factor``."""
        return Window(
            self.width * factor,
            self.height * factor,
            self.focal_px * factor,
            (self.cx + 0.5) * factor - 0.5,
            (self.cy + 0.5) * factor - 0.5,
        )


class SilhouetteRenderer(Protocol):
    """Draws one mesh, again and again."""

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        """(height, width) mask, 255 where the target is.

        Raises:
            RendezviewError: a part of the target lies behind the camera's plane.
        """


class Renderer(StrEnum):
    """Which renderer draws the training views."""

    NUMBA = "numba"
    NUMPY = "numpy"
    PYRENDER = "pyrender"


def make_renderer(kind: Renderer, mesh: Mesh) -> SilhouetteRenderer:
    """A renderer of the mesh.

    Raises:
        RendezviewError: pyrender is asked for but does not import here.
    """
    if kind is Renderer.NUMPY:
        return NumpyRenderer(mesh)
    if kind is Renderer.PYRENDER:
        from rendezview.training.pyrender_renderer import PyrenderRenderer

        return PyrenderRenderer(mesh)
    return NumbaRenderer(mesh)


class NumbaRenderer:
    """Scanline filling, compiled; the default."""

    def __init__(self, mesh: Mesh) -> None:
        self._vertices = np.ascontiguousarray(mesh.vertices_m)
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        points_px = project_vertices(self._vertices, camera_from_target, window)
        mask = np.zeros((window.height, window.width), dtype=np.uint8)
        fill_silhouette(points_px, self._faces, mask)
        return mask


class NumpyRenderer:
    """The reference twin: for each triangle the half-plane test at every pixel of its box."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        points_px = project_vertices(self._mesh.vertices_m, camera_from_target, window)
        mask = np.zeros((window.height, window.width), dtype=np.uint8)
        for a, b, c in points_px[self._mesh.faces]:
            low = np.maximum(np.ceil(np.min([a, b, c], axis=0)).astype(int), 0)
            high = np.floor(np.max([a, b, c], axis=0)).astype(int)
            x, y = np.meshgrid(
                np.arange(low[0], min(high[0], window.width - 1) + 1),
                np.arange(low[1], min(high[1], window.height - 1) + 1),
            )
            if x.size == 0:
                continue
            sides = [
                (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
                for p, q in ((a, b), (b, c), (c, a))
            ]
            inside = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
            mask[y[inside], x[inside]] = 255
        return mask


def project_vertices(vertices_m: Array, camera_from_target: Pose, window: Window) -> Array:
    """Vertices (V, 3) → (V, 2) pixels of the window.

    Raises:
        RendezviewError: a vertex lies at or behind the camera's plane.
    """
    points_px = np.empty((len(vertices_m), 2))
    least = _project(
        vertices_m,
        camera_from_target.rotation,
        camera_from_target.translation_m,
        window.focal_px,
        window.cx,
        window.cy,
        points_px,
    )
    if not least > NEAREST_M:
        raise RendezviewError(
            "part of the target lies behind the camera: the camera stands inside the target, "
            "use a larger sphere radius"
        )
    return points_px


@njit(cache=True, nogil=True)
def _project(
    vertices: Array,
    rotation: Array,
    translation: Array,
    focal: float,
    cx: float,
    cy: float,
    out: Array,
) -> float:
    least = np.inf
    r = rotation
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + translation[2]
        least = min(least, depth)
        scale = focal / depth if depth > 0.0 else np.nan
        out[i, 0] = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + translation[0]) * scale + cx
        out[i, 1] = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + translation[1]) * scale + cy
    return least


@njit(cache=True, nogil=True)
def fill_silhouette(
    points_px: Array, faces: npt.NDArray[np.int32], mask: npt.NDArray[np.uint8]
) -> None:
    """Set to 255 every pixel whose centre lies in a projected triangle.

    Args:
        points_px: (V, 2) projected vertices.
        faces: (F, 3) vertex indices, any winding.
        mask: (H, W) picture, changed in place.
    """
    height, width = mask.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        # from top to bottom
        if points_px[b, 1] < points_px[a, 1]:
            a, b = b, a
        if points_px[c, 1] < points_px[b, 1]:
            b, c = c, b
            if points_px[b, 1] < points_px[a, 1]:
                a, b = b, a
        ax, ay = points_px[a, 0], points_px[a, 1]
        bx, by = points_px[b, 0], points_px[b, 1]
        cx, cy = points_px[c, 0], points_px[c, 1]
        top = max(0, int(np.ceil(ay)))
        bottom = min(height - 1, int(np.floor(cy)))
        if top > bottom or max(ax, bx, cx) < 0.0 or min(ax, bx, cx) > width - 1.0:
            continue
        if cy == ay:  # a sliver along a row of centres
            left = max(0, int(np.ceil(min(ax, bx, cx))))
            right = min(width - 1, int(np.floor(max(ax, bx, cx))))
            mask[top, left : right + 1] = 255
            continue
        long_slope = (cx - ax) / (cy - ay)
        upper_slope = (bx - ax) / (by - ay) if by > ay else 0.0
        lower_slope = (cx - bx) / (cy - by) if cy > by else 0.0
        for y in range(top, bottom + 1):
            x0 = ax + long_slope * (y - ay)
            upper = y < by or cy == by
            x1 = ax + upper_slope * (y - ay) if upper else bx + lower_slope * (y - by)
            if x1 < x0:
                x0, x1 = x1, x0
            left = max(0, int(np.ceil(x0)))
            right = min(width - 1, int(np.floor(x1)))
            row = mask[y]
            for x in range(left, right + 1):
                row[x] = 255
