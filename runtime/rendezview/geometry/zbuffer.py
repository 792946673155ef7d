"""A z-buffer: draws triangles into a buffer of the nearest surface.

A sample is one element of the buffers. Sample (row, column) lies at ``(column, row)`` of the plane
on which the triangles are drawn. A triangle covers samples by the half-open rule: left and top
edges belong to it, right and bottom edges do not. Both triangles of a shared edge compute the edge
from the same end points in the same order, so a closed surface has no holes and no double samples.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Float32s = npt.NDArray[np.float32]
Int32s = npt.NDArray[np.int32]
Float64s = npt.NDArray[np.float64]

NOBODY = -1  # owner of a sample that no triangle covers. Source: by construction

# Ratio by which a later face must be nearer. CAD models often have doubled sheets: the first of two
# coplanar faces wins, instead of a moiré of both. Source: rounding of float32
_NEARER = np.float32(1.0 + 2e-6)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_triangle(
    x0: float, y0: float, w0: float, x1: float, y1: float, w1: float, x2: float, y2: float,
    w2: float, face: int, nearness: Float32s, owner: Int32s,
) -> None:  # fmt: skip
    """Draw one triangle where its ``w`` > 0, linear over the plane, exceeds ``nearness``."""
    height, width = nearness.shape
    first_row = math.ceil(max(0.0, min(y0, y1, y2)))
    last_row = math.ceil(min(float(height), max(y0, y1, y2))) - 1
    # Most triangles of a fine mesh lie between the rows or columns of samples.
    if first_row > last_row or math.ceil(min(x0, x1, x2)) > max(x0, x1, x2):
        return
    if y1 < y0:
        x0, y0, w0, x1, y1, w1 = x1, y1, w1, x0, y0, w0
    if y2 < y0:
        x0, y0, w0, x2, y2, w2 = x2, y2, w2, x0, y0, w0
    if y2 < y1:
        x1, y1, w1, x2, y2, w2 = x2, y2, w2, x1, y1, w1
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if abs(area) < 1e-12:
        return
    w_per_x = ((w1 - w0) * (y2 - y0) - (w2 - w0) * (y1 - y0)) / area
    w_per_y = ((w2 - w0) * (x1 - x0) - (w1 - w0) * (x2 - x0)) / area
    # The gradient of a sliver is huge: its samples are clamped to the values at its corners.
    w_low, w_high = min(w0, w1, w2), max(w0, w1, w2)
    for row in range(first_row, last_row + 1):
        xa = x0 + (row - y0) * (x2 - x0) / (y2 - y0)
        if row < y1:
            xb = x0 + (row - y0) * (x1 - x0) / (y1 - y0)
        else:
            xb = x1 + (row - y1) * (x2 - x1) / (y2 - y1)
        left, right = min(xa, xb), max(xa, xb)
        if right <= 0.0 or left > width - 1:
            continue
        first = math.ceil(max(0.0, left))
        last = math.ceil(min(float(width), right)) - 1
        w_row = w0 + w_per_y * (row - y0) - w_per_x * x0
        for column in range(first, last + 1):
            w = np.float32(min(max(w_row + w_per_x * column, w_low), w_high))
            if w > nearness[row, column] * _NEARER:
                nearness[row, column] = w
                owner[row, column] = face


@njit(cache=True, nogil=True, error_model="numpy")
def draw_perspective(
    vertices: Float64s, faces: Int32s, fx: float, fy: float, cx: float, cy: float, near: float,
    nearness: Float32s, owner: Int32s,
) -> None:  # fmt: skip
    """Draw triangles of the camera frame, clipped at ``z = near``; ``w`` is 1/z.

    1/z is linear in the picture, so depth is perspective-correct. ``fx`` to ``cy`` are intrinsics
    of the sample plane.
    """
    placed = np.empty((vertices.shape[0], 3))
    for v in range(vertices.shape[0]):
        inverse = 1.0 / vertices[v, 2] if vertices[v, 2] >= near else 0.0
        placed[v, 0] = fx * vertices[v, 0] * inverse + cx
        placed[v, 1] = fy * vertices[v, 1] * inverse + cy
        placed[v, 2] = inverse
    polygon = np.empty((4, 3))
    for face in range(faces.shape[0]):
        in_front, count = 0, 0
        for k in range(3):
            if placed[faces[face, k], 2] > 0.0:
                in_front += 1
        if in_front == 0:
            continue
        # Sutherland–Hodgman clipping at one plane: three or four corners remain.
        for k in range(3):
            a, b = faces[face, k], faces[face, (k + 1) % 3]
            if placed[a, 2] > 0.0:
                for axis in range(3):  # not the row at once: numba compiles that for two seconds
                    polygon[count, axis] = placed[a, axis]
                count += 1
            if in_front < 3 and (placed[a, 2] > 0.0) != (placed[b, 2] > 0.0):
                share = (near - vertices[a, 2]) / (vertices[b, 2] - vertices[a, 2])
                x = vertices[a, 0] + share * (vertices[b, 0] - vertices[a, 0])
                y = vertices[a, 1] + share * (vertices[b, 1] - vertices[a, 1])
                inverse = 1.0 / near
                polygon[count, 0], polygon[count, 1] = fx * x * inverse + cx, fy * y * inverse + cy
                polygon[count, 2] = inverse
                count += 1
        for k in range(1, count - 1):
            fill_triangle(
                polygon[0, 0], polygon[0, 1], polygon[0, 2],
                polygon[k, 0], polygon[k, 1], polygon[k, 2],
                polygon[k + 1, 0], polygon[k + 1, 1], polygon[k + 1, 2],
                face, nearness, owner,
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def draw_parallel(vertices: Float64s, faces: Int32s, nearness: Float32s, owner: Int32s) -> None:
    """Draw triangles whose vertices are (x, y, w) on the sample plane."""
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        fill_triangle(
            vertices[a, 0], vertices[a, 1], vertices[a, 2],
            vertices[b, 0], vertices[b, 1], vertices[b, 2],
            vertices[c, 0], vertices[c, 1], vertices[c, 2],
            face, nearness, owner,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def draw_chosen(
    vertices: Float64s, faces: Int32s, chosen: npt.NDArray[np.intp], nearness: Float32s,
    owner: Int32s,
) -> None:  # fmt: skip
    """``draw_parallel`` of some of the faces, in the given order."""
    for k in range(chosen.shape[0]):
        face = chosen[k]
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        fill_triangle(
            vertices[a, 0], vertices[a, 1], vertices[a, 2],
            vertices[b, 0], vertices[b, 1], vertices[b, 2],
            vertices[c, 0], vertices[c, 1], vertices[c, 2],
            face, nearness, owner,
        )  # fmt: skip


def empty_buffers(height: int, width: int) -> tuple[Float32s, Int32s]:
    """Empty ``nearness`` (0 is infinitely far) and ``owner`` buffers."""
    return np.zeros((height, width), np.float32), np.full((height, width), NOBODY, np.int32)


def draw_from_afar(
    vertices: Float64s, faces: Int32s, axes: Float64s, scale: float, side: int
) -> tuple[Float32s, Int32s]:
    """(side, side) height and face of a body (V, 3) that is seen from afar.

    Args:
        vertices: about the middle of the picture; within half a side of it.
        axes: (3, 3) those of the picture in rows, the last towards the eye.
        scale: samples for each unit of length, also of the height.
    """
    on_plane = vertices @ axes.T * scale + 0.5 * side
    on_plane[:, 2] += side  # above 0, which is empty
    height, owner = empty_buffers(side, side)
    draw_parallel(on_plane, faces, height, owner)
    return height, owner
