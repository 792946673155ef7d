"""Strips: the surfaces beside an edge, in cells along its image normal.

A bevel or the rim of a panel is often narrower than a pixel of the drawn view, and moves the edge
that a camera sees by as much: so it is the triangles that say what is seen at a place, and the
pixels around it only which triangles to ask.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.appearance.contours import CELLS, OUTLINE_CELLS, RIM_CELLS, cell_limits
from rendezview.pose import Array
from rendezview.training.crossings import KIND, STEP_RADII, depth_on
from rendezview.training.drawn_view import DrawnView

_ASIDE = 1.0 / 196.0  # of the target's radius, apart are five samples of a strip along the edge
_SAMPLES_PER_PX = 4.0  # along the normal …
_LEAST_SAMPLES, _MOST_SAMPLES = 4, 8  # … of a cell
_ON_EDGE_PX = 1e-6
_SAME_DEPTH = 2e-6
_RIM_STEP_PX = 1.0 / 16.0
_SAME_NORMAL = np.cos(np.deg2rad(12.0))  # within which, and
_SAME_ALBEDO = 0.05  # within which two facets are one surface


def strips(
    crossings: Array, view: DrawnView, normals: Array, albedo: Array, radius_px: float
) -> tuple[Array, Array, Array]:
    """Mean surfaces in the cells along the image normals of N contour points.

    A cell is as wide along the edge as the reading of the picture. The sky counts as black.

    Args:
        crossings: (N, 10) of ``edge_crossings``.
        normals: (F, 3) of ``face_normals``, camera frame.
        albedo: (F,).
        radius_px: of the target.

    Returns:
        (N, CELLS, 3) unit normals, camera frame, (N, CELLS) albedo, and (N, 2) of an outline's
        rim: its width, pixels, 0 where there is none, and how much deeper than the point it
        ends, m.
    """
    corners = view.vertices[:, :2] / view.vertices[:, 2:] * view.focal + view.middle
    return _strips(  # type: ignore[no-any-return]
        crossings, view.vertices, corners, view.faces, view.focal, view.middle, view.owner,
        normals, albedo, radius_px,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _inside(corners, face, x, y):  # type: ignore[no-untyped-def]
    """Whether a place lies in a projected face or on its edge."""
    least, most = 1e9, -1e9
    for k in range(3):
        a, b = corners[face[k]], corners[face[(k + 1) % 3]]
        ex, ey = b[0] - a[0], b[1] - a[1]
        away = (ex * (y - a[1]) - ey * (x - a[0])) / (np.sqrt(ex * ex + ey * ey) + 1e-30)
        least, most = min(least, away), max(most, away)
    return least >= -_ON_EDGE_PX or most <= _ON_EDGE_PX


@njit(cache=True, nogil=True)
def _face_at(x, y, vertices, corners, faces, focal, middle, owner, normals):  # type: ignore[no-untyped-def]
    """The face that is seen at a place between the pixels' centres; −1: none.

    Of the faces seen around it the nearest that covers it; where none does, the pixel's own.
    """
    height, width = owner.shape
    column, row = int(np.rint(x)), int(np.rint(y))
    own = owner[row, column]
    rx, ry = (x - middle) / focal, (y - middle) / focal
    seen, nearest, last = -1, np.inf, -1
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if not (0 <= row + dy < height and 0 <= column + dx < width):
                continue
            face = owner[row + dy, column + dx]
            if face < 0 or face == last:
                continue
            last = face
            if face == seen or not _inside(corners, faces[face], x, y):
                continue
            z = depth_on(vertices, faces, face, normals, rx, ry)
            if z <= 0.0 or z > nearest * (1.0 + _SAME_DEPTH):
                continue
            # Of two faces in one plane the first, as everywhere.
            if z < nearest * (1.0 - _SAME_DEPTH) or face < seen:
                seen, nearest = face, min(z, nearest)
    return seen if seen >= 0 else own


@njit(cache=True, nogil=True)
def _rim(  # type: ignore[no-untyped-def]
    x, y, z, tx, ty, most, step, vertices, corners, faces, focal, middle, owner, normals, albedo
):
    """Width, pixels, of the first surface inside an outline, and the depth where it ends.

    0 where it goes on for ``most`` pixels; ``step`` metres make a step in depth. What ends there
    is the nearer of the two surfaces.
    """
    height, width = owner.shape
    first = -1
    before = 0.0
    for k in range(int(most / _RIM_STEP_PX)):
        depth = (k + 0.5) * _RIM_STEP_PX
        u, v = x - depth * ty, y + depth * tx
        if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
            break
        face = _face_at(u, v, vertices, corners, faces, focal, middle, owner, normals)
        rx, ry = (u - middle) / focal, (v - middle) / focal
        if face < 0:
            if first < 0:
                continue
            return depth - 0.5 * _RIM_STEP_PX, before - z
        here = depth_on(vertices, faces, face, normals, rx, ry)
        if first < 0:
            first = face
        elif face != first:
            n, m = normals[first], normals[face]
            cosine = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
            paint = abs(albedo[face] - albedo[first])
            if cosine < _SAME_NORMAL or paint > _SAME_ALBEDO or abs(here - before) > step:
                return depth - 0.5 * _RIM_STEP_PX, min(before, here) - z
        before = here
    return 0.0, 0.0


@njit(cache=True, nogil=True)
def _strips(  # type: ignore[no-untyped-def]
    points, vertices, corners, faces, focal, middle, owner, normals, albedo, radius_px
):
    height, width = owner.shape
    aside = _ASIDE * radius_px
    towards = np.zeros((points.shape[0], CELLS, 3))
    colour = np.zeros((points.shape[0], CELLS))
    rim = np.zeros((points.shape[0], 2))
    for j in range(points.shape[0]):
        x, y, z = points[j, 2], points[j, 3], points[j, 4]
        tx, ty = points[j, 5] - x / z * points[j, 7], points[j, 6] - y / z * points[j, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        tx, ty = tx / length, ty / length
        outline = points[j, KIND] == 0.0
        if outline:
            most = OUTLINE_CELLS[RIM_CELLS] * radius_px
            rim[j] = _rim(
                points[j, 0], points[j, 1], z, tx, ty, most, STEP_RADII * radius_px * z / focal,
                vertices, corners, faces, focal, middle, owner, normals, albedo,
            )  # fmt: skip
        for cell in range(CELLS):
            near, far = cell_limits(outline, cell)
            near, far = near * radius_px, far * radius_px
            if cell == 0 and rim[j, 0] > 0.0:
                far = rim[j, 0]
            elif cell == 1 and rim[j, 0] > 0.0:
                near = rim[j, 0]
            steps = int(np.ceil((far - near) * _SAMPLES_PER_PX))
            steps = min(max(steps, _LEAST_SAMPLES), _MOST_SAMPLES)
            samples = 0
            for a in range(steps):
                depth = near + (far - near) * (a + 0.5) / steps
                for b in range(-2, 3):
                    u = points[j, 0] - depth * ty + aside * b * tx
                    v = points[j, 1] + depth * tx + aside * b * ty
                    samples += 1
                    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                        continue
                    face = _face_at(
                        u, v, vertices, corners, faces, focal, middle, owner, normals
                    )  # fmt: skip
                    if face < 0:
                        if outline and depth < 1.0:
                            samples -= 1  # the edge may bend
                        continue
                    colour[j, cell] += albedo[face]
                    for k in range(3):
                        towards[j, cell, k] += albedo[face] * normals[face, k]
            if samples > 0:
                colour[j, cell] /= samples
            size = 0.0
            for k in range(3):
                size += towards[j, cell, k] ** 2
            if size > 0.0:
                towards[j, cell] /= np.sqrt(size)
            else:
                colour[j, cell] = 0.0
    return towards, colour, rim
