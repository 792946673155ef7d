"""Crossings of a view's edges with the lines between pixel centres, exactly.

A picture of the nearest surface tells which triangle is seen at every pixel. Between two
neighbouring pixels of which one shows the sky, a far surface or another facet there is an
edge, and it is an edge of one of the triangles seen there: its crossing with the line
between the two pixel centres is computed from the triangle, not from the pixels. So the
points are exact in space although the picture has a few hundred pixels a side.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.training.mesh import Mesh

STEP_RADII = 0.02  # of the target's radius: so much deeper lies another surface
_CREASE_COSINE = np.cos(np.deg2rad(30.0))  # facets that meet at a greater angle give a crease
_FAINT_COLOUR = 0.12  # as do facets whose albedo differs by more
# Columns of a crossing: u v, point (3), tangent (3), then
KIND, LENGTH = 8, 9  # length of the outline that it stands for, pixels


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


def face_normals(vertices: Array, faces: npt.NDArray[np.int32]) -> Array:
    """Unit normals (F, 3), towards the camera; towards it straight where a face has no area."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-30)[:, None]
    normals[np.einsum("fi,fi->f", normals, corners[:, 0]) > 0.0] *= -1.0
    normals[length < 1e-30] = (0.0, 0.0, -1.0)
    return normals


@njit(cache=True, nogil=True)
def depth_on(vertices, faces, face, normals, rx, ry):  # type: ignore[no-untyped-def]
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
def edge_crossings(  # type: ignore[no-untyped-def]
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
                    z_here = depth_on(vertices, faces, face, normals, rx, ry)
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
                            z = depth_on(vertices, faces, near, normals, rx, ry)
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
