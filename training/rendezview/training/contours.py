"""Contour points of a view: where edges of the target stand in the picture, exactly.

A picture of the nearest surface tells which triangle is seen at every pixel. Between two
neighbouring pixels of which one shows the sky, a far surface or another facet there is an
edge, and it is an edge of one of the triangles seen there: its crossing with the line
between the two pixel centres is computed from the triangle, not from the pixels. So the
points are exact in space although the picture has a few hundred pixels a side.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.appearance.contours import (
    CELLS,
    DIRECTION_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    RUN_UNIT,
    cell_limits,
)
from rendezview.pose import Array
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions, ViewGeometry
from rendezview.training.surface_palette import packed_surfaces
from rendezview.training.views import look_from
from rendezview.training.zbuffer import draw_perspective, empty_buffers

_STEP_RADII = 0.02  # a surface that lies further behind by so much gives a step
_CREASE_COSINE = np.cos(np.deg2rad(30.0))  # facets that meet at a greater angle give a crease
_FAINT_COLOUR = 0.12  # as do facets whose albedo differs by more
_CLEAR_PX = 6.0  # a run of so many pixels makes an edge as good as any
_ASIDE = 1.0 / 196.0  # of the target's radius, apart are five samples of a strip along the edge
_FREE_PX = 64  # how far the free run along the normal is looked for
# Columns of a crossing: u v, point (3), tangent (3), then
_KIND, _LENGTH = 8, 9  # length of the outline that it stands for, pixels
_INNER_SHARE = 0.3  # of the points, for steps and creases inside the outline


def contour_points(
    mesh: Mesh,
    beside: npt.NDArray[np.int32],
    geometry: ViewGeometry,
    direction: Array,
    range_m: float,
    options: TrainingOptions,
) -> dict[str, npt.NDArray[Any]]:
    """Contour points of the target seen from a unit direction (3,) at a range.

    Args:
        beside: of ``faces_beside(mesh)``.
        options: for the number of points and the resolution at which the view is drawn.

    Returns:
        The fields of ``rendezview.appearance.contours.Contours`` for this one view, but instead
        of ``strip`` the ``surfaces`` (N, CELLS, 4) for ``surface_palette``.
    """
    rotation = look_from(direction)
    vertices = (mesh.vertices_m - geometry.centre_m) @ rotation.T + np.array([0.0, 0.0, range_m])
    tangent = np.tan(np.arcsin(geometry.target_radius_m / range_m))
    size = options.contour_resolution_px
    focal = (0.5 * size - 4.0) / tangent
    middle = 0.5 * (size - 1)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
    nearness, owner = empty_buffers(size, size)
    draw_perspective(vertices, faces, focal, focal, middle, middle, 1e-3, nearness, owner)
    albedo = mesh.face_albedo
    normals = _normals(vertices, faces)
    step_m = _STEP_RADII * geometry.target_radius_m
    crossings = _crossings(
        vertices,
        vertices[:, :2] / vertices[:, 2:] * focal + middle,
        faces,
        normals,
        beside,
        albedo,
        focal,
        middle,
        nearness,
        owner,
        step_m,
    )
    edges = np.zeros(owner.shape, dtype=np.bool_)
    _mark(crossings, edges)
    count = options.contour_points
    inner = round(_INNER_SHARE * count)
    # Runs are looked for at four times as many points as are kept.
    crossings = crossings[_chosen(crossings, 4 * (count - inner), 4 * inner)]
    runs_px = _free_runs(crossings, focal, edges, nearness, step_m)
    # A body thinner than the blur shows its edges displaced: such edges only where need be.
    crossings[:, _LENGTH] *= np.clip((runs_px.min(axis=1) - 2.0) / _CLEAR_PX, 0.02, 1.0)
    chosen = _chosen(crossings, count - inner, inner)
    kept = crossings[chosen]
    runs_m = runs_px[chosen] * (kept[:, 4] / focal)[:, None]
    place = (kept[:, 2:5] - np.array([0.0, 0.0, range_m])) @ rotation
    radius_m = geometry.target_radius_m
    towards, colour = _strips(kept, focal, owner, normals, albedo, focal * tangent)
    surfaces = packed_surfaces(towards @ rotation, colour)
    return {
        "point": _packed(place / (radius_m * POINT_UNIT), count, np.int16),
        "tangent": _packed(kept[:, 5:8] @ rotation / DIRECTION_UNIT, count, np.int8),
        "kind": _packed(kept[:, _KIND], count, np.uint8, NO_POINT),
        "run": _packed(np.minimum(runs_m / (radius_m * RUN_UNIT), 255.0), count, np.uint8),
        "surfaces": _packed(surfaces, count, np.uint8),
    }


def _packed(
    values: npt.NDArray[Any], count: int, dtype: type[np.integer[Any]], fill: int = 0
) -> npt.NDArray[Any]:
    """Whole numbers, filled up to ``count`` rows."""
    packed = np.full((count, *values.shape[1:]), fill, dtype=dtype)
    packed[: len(values)] = np.rint(values)
    return packed


def _chosen(crossings: Array, outline: int, inner: int) -> npt.NDArray[np.intp]:
    """Points spread evenly over the length of the edges: the outline's first, then the others."""
    inside = crossings[:, _KIND] > OUTLINE
    return np.concatenate(
        [
            _spread(crossings, np.flatnonzero(~inside), outline),
            _spread(crossings, np.flatnonzero(inside), inner),
        ]
    )


def _spread(crossings: Array, candidates: npt.NDArray[np.intp], count: int) -> npt.NDArray[np.intp]:
    """``count`` of the candidates at equal steps of length along a curve that fills the picture."""
    if len(candidates) <= count:
        return candidates
    x, y = crossings[candidates, 0], crossings[candidates, 1]
    order = candidates[np.argsort(_morton(x, y), kind="stable")]
    length = np.cumsum(crossings[order, _LENGTH])
    places = (np.arange(count) + 0.5) / count * length[-1]
    return np.unique(order[np.searchsorted(length, places)])


def _morton(x: Array, y: Array) -> npt.NDArray[np.int64]:
    """Place on the Z-order curve over cells of 4 × 4 pixels."""
    code = np.zeros(len(x), dtype=np.int64)
    a, b = (x / 4.0).astype(np.int64), (y / 4.0).astype(np.int64)
    for bit in range(12):
        code |= ((a >> bit) & 1) << (2 * bit)
        code |= ((b >> bit) & 1) << (2 * bit + 1)
    return code


def faces_beside(mesh: Mesh) -> npt.NDArray[np.int32]:
    """(F, 3) the face on the other side of each edge (vertex k to k + 1), −1 where there is none.

    Where more than two faces meet at an edge, any other one.
    """
    _, welded = np.unique(mesh.vertices_m, axis=0, return_inverse=True)
    faces = welded.reshape(-1)[mesh.faces]
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = np.all(edges[order[1:]] == edges[order[:-1]], axis=1)
    beside = np.full(len(edges), -1, dtype=np.int32)
    first, second = order[:-1][same], order[1:][same]
    beside[first] = second // 3
    beside[second] = first // 3
    return beside.reshape(-1, 3)


def _normals(vertices: Array, faces: npt.NDArray[np.int32]) -> Array:
    """Unit normals (F, 3), towards the camera; towards it straight where a face has no area."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-30)[:, None]
    normals[np.einsum("fi,fi->f", normals, corners[:, 0]) > 0.0] *= -1.0
    normals[length < 1e-30] = (0.0, 0.0, -1.0)
    return normals


@njit(cache=True, nogil=True)
def _depth_on(vertices, faces, face, normals, rx, ry):  # type: ignore[no-untyped-def]
    """z where the ray (rx, ry, 1) meets the plane of a face; 0 where it runs along it."""
    a = faces[face, 0]
    normal = normals[face]
    down = normal[0] * rx + normal[1] * ry + normal[2]
    if abs(down) < 1e-9:
        return 0.0
    return (
        normal[0] * vertices[a, 0] + normal[1] * vertices[a, 1] + normal[2] * vertices[a, 2]
    ) / down


@njit(cache=True, nogil=True)
def _exit(points, faces, face, px, py, dx, dy):  # type: ignore[no-untyped-def]
    """Interval [enter, leave] of p + s d inside a projected face, and the edge of the exit."""
    enter, leave, edge = -1e9, 1e9, -1
    p, q, r = points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]]
    area = (q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1])
    if abs(area) < 1e-9:
        return 1.0, 0.0, -1
    side = 1.0 if area > 0.0 else -1.0
    for k in range(3):
        a, b = points[faces[face, k]], points[faces[face, (k + 1) % 3]]
        ex, ey = b[0] - a[0], b[1] - a[1]
        at = side * (ex * (py - a[1]) - ey * (px - a[0]))  # ≥ 0 inside
        slope = side * (ex * dy - ey * dx)
        if abs(slope) < 1e-12:
            if at < -1e-9:
                return 1.0, 0.0, -1
            continue
        s = -at / slope
        if slope > 0.0:
            enter = max(enter, s)
        elif s < leave:
            leave, edge = s, k
    return enter, leave, edge


@njit(cache=True, nogil=True)
def _crossings(  # type: ignore[no-untyped-def]
    vertices, points, faces, normals, beside, albedo, focal, middle, nearness, owner, step
):
    """Every edge between neighbouring pixels: (M, 10) rows."""
    height, width = owner.shape
    rows = np.empty((4096, 10))
    count = 0
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            face = owner[y, x]
            if face < 0:
                continue
            for side in range(4):
                dx = (1, 0, -1, 0)[side]
                dy = (0, 1, 0, -1)[side]
                beyond = owner[y + dy, x + dx]
                if beyond == face:
                    continue
                kind = 0
                if beyond >= 0:
                    rx, ry = (x + dx - middle) / focal, (y + dy - middle) / focal
                    z_here = _depth_on(vertices, faces, face, normals, rx, ry)
                    z_there = 1.0 / nearness[y + dy, x + dx]
                    z_own = 1.0 / nearness[y, x]
                    if z_there - z_own > step and (z_here <= 0.0 or z_there - z_here > step):
                        kind = 1
                    elif side < 2 and abs(z_there - z_own) < step:
                        n, m = normals[face], normals[beyond]
                        cosine = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
                        paint = abs(albedo[face] - albedo[beyond])
                        if cosine > _CREASE_COSINE and paint < _FAINT_COLOUR:
                            continue
                        kind = 2
                    else:
                        continue
                enter, leave, edge = _exit(points, faces, face, x, y, dx, dy)
                last = face
                if edge < 0 or enter > 0.5 or leave < -0.5:
                    continue
                if kind < 2:
                    # Go on over near triangles that are seen next to this one.
                    again = True
                    while again and leave < 1.0:
                        again = False
                        # first over the edge itself: a facet seen edge-on owns no pixel
                        for around in range(10):
                            if around == 0:
                                near = beside[last, edge]
                            else:
                                near = owner[y + (around - 1) // 3 - 1, x + (around - 1) % 3 - 1]
                            if near < 0 or near == last:
                                continue
                            e, f, g = _exit(points, faces, near, x, y, dx, dy)
                            if g < 0 or e > leave + 1e-3 or f <= leave + 1e-6:
                                continue
                            # … on the same surface
                            rx = (x + dx * leave - middle) / focal
                            ry = (y + dy * leave - middle) / focal
                            z = _depth_on(vertices, faces, near, normals, rx, ry)
                            if abs(z - 1.0 / nearness[y, x]) > step:
                                continue
                            last, leave, edge, again = near, f, g, True
                if leave < -0.01 or leave > 1.01:
                    continue
                a, b = faces[last, edge], faces[last, (edge + 1) % 3]
                rx, ry = (x + dx * leave - middle) / focal, (y + dy * leave - middle) / focal
                # Depth on the edge itself: the two lines in space meet in the picture.
                ax, ay = vertices[a, 0] / vertices[a, 2], vertices[a, 1] / vertices[a, 2]
                bx, by = vertices[b, 0] / vertices[b, 2], vertices[b, 1] / vertices[b, 2]
                along = ((rx - ax) * (bx - ax) + (ry - ay) * (by - ay)) / (
                    (bx - ax) ** 2 + (by - ay) ** 2 + 1e-30
                )
                along = min(max(along, 0.0), 1.0)
                w = (1.0 - along) / vertices[a, 2] + along / vertices[b, 2]
                tx, ty = bx - ax, by - ay
                length = np.sqrt(tx * tx + ty * ty)
                if length < 1e-12:
                    continue
                # The outward image normal is (t_y, −t_x).
                facing = (ty * dx - tx * dy) / length
                sign = 1.0 if facing > 0.0 else -1.0
                if count == rows.shape[0]:
                    grown = np.empty((2 * count, 10))
                    grown[:count] = rows
                    rows = grown
                row = rows[count]
                z = 1.0 / w
                row[0], row[1] = x + dx * leave, y + dy * leave
                row[2], row[3], row[4] = rx * z, ry * z, z
                total = 0.0
                for k in range(3):
                    row[5 + k] = sign * (vertices[b, k] - vertices[a, k])
                    total += row[5 + k] ** 2
                total = np.sqrt(total)
                for k in range(3):
                    row[5 + k] /= total
                row[8] = kind
                row[9] = abs(facing)
                count += 1
    return rows[:count]


@njit(cache=True, nogil=True)
def _mark(crossings, edges):  # type: ignore[no-untyped-def]
    for k in range(crossings.shape[0]):
        edges[int(np.rint(crossings[k, 1])), int(np.rint(crossings[k, 0]))] = True


@njit(cache=True, nogil=True)
def _free_runs(points, focal, edges, nearness, step):  # type: ignore[no-untyped-def]
    """(N, 2) pixels along the image normal to the next edge, inwards and outwards.

    Nearer than 2.5 pixels the marks of an edge's own line are in the way: there a run ends
    where the body does, or where another begins.
    """
    height, width = edges.shape
    runs = np.empty((points.shape[0], 2))
    for k in range(points.shape[0]):
        x, y, z = points[k, 2], points[k, 3], points[k, 4]
        # Picture of the tangent: d(x/z, y/z)
        tx = points[k, 5] - x / z * points[k, 7]
        ty = points[k, 6] - y / z * points[k, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        nx, ny = ty / length, -tx / length
        for way in range(2):
            sign = 1.0 if way else -1.0
            run = 0.75
            while run < _FREE_PX:
                column = int(np.rint(points[k, 0] + sign * run * nx))
                row = int(np.rint(points[k, 1] + sign * run * ny))
                if not (0 <= row < height and 0 <= column < width):
                    run = _FREE_PX
                    break
                if run >= 2.5:
                    if edges[row, column]:
                        break
                elif way == 0:
                    if nearness[row, column] * (z + step) < 1.0:
                        break
                elif points[k, 8] == 0.0 and nearness[row, column] > 0.0:
                    break
                run += 0.25 if run < 2.5 else 0.5
            runs[k, way] = run
    return runs


@njit(cache=True, nogil=True)
def _strips(points, focal, owner, normals, albedo, radius_px):  # type: ignore[no-untyped-def]
    """Normals (N, CELLS, 3) and albedo (N, CELLS) along the image normals of the points.

    Mean over a cell as far to either side along the edge as the reading of the picture goes;
    the sky counts as black.
    """
    height, width = owner.shape
    aside = _ASIDE * radius_px
    towards = np.zeros((points.shape[0], CELLS, 3))
    colour = np.zeros((points.shape[0], CELLS))
    for j in range(points.shape[0]):
        x, y, z = points[j, 2], points[j, 3], points[j, 4]
        tx, ty = points[j, 5] - x / z * points[j, 7], points[j, 6] - y / z * points[j, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        tx, ty = tx / length, ty / length
        outline = points[j, 8] == 0.0
        for cell in range(CELLS):
            near, far = cell_limits(outline, cell)
            near, far = near * radius_px, far * radius_px
            steps = max(2, int(np.ceil((far - near) * 1.5)))
            samples = 0
            for a in range(steps):
                depth = near + (far - near) * (a + 0.5) / steps
                for b in range(-2, 3):
                    column = int(np.rint(points[j, 0] - depth * ty + aside * b * tx))
                    row = int(np.rint(points[j, 1] + depth * tx + aside * b * ty))
                    samples += 1
                    if not (0 <= row < height and 0 <= column < width):
                        continue
                    face = owner[row, column]
                    if face < 0:
                        if outline and depth < 1.0:
                            samples -= 1  # the nearest sample may lie just outside
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
    return towards, colour
