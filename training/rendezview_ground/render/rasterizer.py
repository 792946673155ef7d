"""Silhouettes of a mesh: a compiled scanline rasteriser and its numpy reference.

A pixel is set when a triangle covers its centre. No triangle is culled, because the winding of
real CAD files is unreliable.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, Pose
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Mask, Window, project_vertices


class NumbaRenderer:
    """Compiled scanline filling; the default renderer."""

    def __init__(self, mesh: Mesh) -> None:
        self._vertices = np.ascontiguousarray(mesh.vertices_m)
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        points_px = project_vertices(self._vertices, camera_from_target, window)
        mask = np.zeros((window.height, window.width), dtype=np.uint8)
        fill_silhouette(points_px, self._faces, mask)
        return mask


class NumpyRenderer:
    """The numpy reference: a half-plane test at every pixel of each triangle's box."""

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


@njit(cache=True, nogil=True, error_model="numpy")
def fill_silhouette(
    points_px: Array, faces: npt.NDArray[np.int32], mask: npt.NDArray[np.uint8]
) -> None:
    """Set every pixel whose centre lies in a projected triangle to 255.

    Args:
        points_px: (V, 2) projected vertices.
        faces: (F, 3) vertex indices, any winding.
        mask: (H, W) picture, changed in place.
    """
    height, width = mask.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        # sorted from top to bottom
        if points_px[b, 1] < points_px[a, 1]:
            a, b = b, a
        if points_px[c, 1] < points_px[b, 1]:
            b, c = c, b
            if points_px[b, 1] < points_px[a, 1]:
                a, b = b, a
        ax, ay = points_px[a, 0], points_px[a, 1]
        bx, by = points_px[b, 0], points_px[b, 1]
        cx, cy = points_px[c, 0], points_px[c, 1]
        top = max(0, math.ceil(ay))
        bottom = min(height - 1, math.floor(cy))
        low, high = max(0.0, min(ax, bx, cx)), min(width - 1.0, max(ax, bx, cx))
        if top > bottom or math.ceil(low) > high:  # no pixel centre between its borders
            continue
        if cy == ay:  # a sliver along a row of pixel centres
            mask[top, math.ceil(low) : math.floor(high) + 1] = 255
            continue
        long_slope = (cx - ax) / (cy - ay)
        upper_slope = (bx - ax) / (by - ay) if by > ay else 0.0
        lower_slope = (cx - bx) / (cy - by) if cy > by else 0.0
        for y in range(top, bottom + 1):
            x0 = ax + long_slope * (y - ay)
            upper = y < by or cy == by
            x1 = ax + upper_slope * (y - ay) if upper else bx + lower_slope * (y - by)
            left = math.ceil(max(0.0, min(x0, x1)))
            right = math.floor(min(width - 1.0, max(x0, x1)))
            if left > right:
                continue
            # Unsigned numbers need no test for a place counted from the end.
            row, first, last = mask[np.uint64(y)], np.uint64(left), np.uint64(right)
            row[first] = row[last] = 255
            if right - left > 1:  # most rows of a fine mesh have one pixel or two
                for x in range(first + np.uint64(1), last):
                    row[x] = 255
