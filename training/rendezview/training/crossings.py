"""Exact crossings of a view's edges with the lines between pixel centres.

A z-buffer holds the visible triangle of every pixel. Where two neighbouring pixels show different
surfaces (target and sky, near and far, two facets), an edge of a visible triangle runs between
them. The crossing of that edge with the line between the two pixel centres is computed from the
triangle. The points are therefore exact in space, although the picture has few pixels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.training.mesh import Mesh
from rendezview.training.zbuffer import Float32s, Int32s

STEP_RADII = 0.02  # target radii; a surface that much deeper is another surface
_CREASE_COSINE = np.cos(np.deg2rad(30.0))  # facets that meet at a greater angle form a crease
_FAINT_COLOUR = 0.12  # albedo; facets that differ by more form a crease, too
_ROWS = 4096  # crossings; first size of the table, which doubles when it is full
_OUTLINE, _STEP, _CREASE = 0, 1, 2  # kinds of edges: against the sky, in depth, in normal or albedo
# Columns of a crossing: u v, point (3), tangent (3), then
KIND, LENGTH = 8, 9  # kind of the edge; length of the outline that it represents, px
_COLUMNS = 10


def faces_beside(mesh: Mesh) -> npt.NDArray[np.int32]:
    """(F, 3) the face on the other side of each edge (vertex k to k + 1), −1 where there is none.

    Where more than two faces meet at an edge, the result is any other one of them.
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
    """Unit normals (F, 3) towards the camera; (0, 0, −1) for a face without area."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-30)[:, None]
    normals[np.einsum("fi,fi->f", normals, corners[:, 0]) > 0.0] *= -1.0
    normals[length < 1e-30] = (0.0, 0.0, -1.0)
    return normals


@njit(cache=True, nogil=True)
def depth_on(
    vertices: Array, faces: Int32s, face: int, normals: Array, rx: float, ry: float
) -> float:
    """Depth z where the ray (rx, ry, 1) meets the plane of a face; 0 for a parallel ray."""
    a = faces[face, 0]
    normal = normals[face]
    down = normal[0] * rx + normal[1] * ry + normal[2]
    if abs(down) < 1e-9:
        return 0.0
    meeting = (
        normal[0] * vertices[a, 0] + normal[1] * vertices[a, 1] + normal[2] * vertices[a, 2]
    ) / down
    return float(meeting)


@njit(cache=True, nogil=True)
def line_in_face(
    points: Array, faces: Int32s, face: int, px: float, py: float, dx: float, dy: float
) -> tuple[float, float, int]:
    """Interval [enter, leave] of p + s d inside a projected face, and the edge it leaves through.

    A face seen edge-on, or a line that misses it, gives the empty interval (1, 0) and edge −1.
    """
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
def _edge_kind(
    vertices: Array, faces: Int32s, normals: Array, albedo: Array, focal: float, middle: float,
    nearness: Float32s, owner: Int32s, step: float, x: int, y: int, dx: int, dy: int,
) -> int:  # fmt: skip
    """Kind of the edge between pixel (x, y) and its neighbour at (dx, dy); −1: no edge.

    A step belongs to its nearer pixel. A crease is counted once, from its left or upper pixel.
    """
    face, beyond = owner[y, x], owner[y + dy, x + dx]
    if beyond < 0:
        return _OUTLINE
    rx, ry = (x + dx - middle) / focal, (y + dy - middle) / focal
    z_here = depth_on(vertices, faces, face, normals, rx, ry)
    z_there = 1.0 / nearness[y + dy, x + dx]
    z_own = 1.0 / nearness[y, x]
    if z_there - z_own > step and (z_here <= 0.0 or z_there - z_here > step):
        return _STEP
    if dx + dy > 0 and abs(z_there - z_own) < step:
        n, m = normals[face], normals[beyond]
        cosine = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
        paint = abs(albedo[face] - albedo[beyond])
        if cosine > _CREASE_COSINE and paint < _FAINT_COLOUR:
            return -1
        return _CREASE
    return -1


@njit(cache=True, nogil=True)
def _followed(
    vertices: Array, points: Array, faces: Int32s, normals: Array, beside: Int32s, focal: float,
    middle: float, nearness: Float32s, owner: Int32s, step: float, x: int, y: int, dx: int, dy: int,
    face: int, leave: float, edge: int,
) -> tuple[int, float, int]:  # fmt: skip
    """Follow the line over adjoining visible triangles of the same surface, to the last of them.

    Returns:
        The last face, where the line leaves it, and through which edge.
    """
    last = face
    again = True
    while again and leave < 1.0:
        again = False
        # The face across the edge comes first: a facet seen edge-on owns no pixel.
        for around in range(10):
            if around == 0:
                near = beside[last, edge]
            else:
                near = owner[y + (around - 1) // 3 - 1, x + (around - 1) % 3 - 1]
            if near < 0 or near == last:
                continue
            e, f, g = line_in_face(points, faces, near, x, y, dx, dy)
            if g < 0 or e > leave + 1e-3 or f <= leave + 1e-6:
                continue
            rx = (x + dx * leave - middle) / focal
            ry = (y + dy * leave - middle) / focal
            z = depth_on(vertices, faces, near, normals, rx, ry)
            if abs(z - 1.0 / nearness[y, x]) > step:  # another surface
                continue
            last, leave, edge, again = near, f, g, True
    return last, leave, edge


@njit(cache=True, nogil=True)
def _write_crossing(
    row: Array, vertices: Array, a: int, b: int, u: float, v: float, dx: int, dy: int, focal: float,
    middle: float, kind: int,
) -> bool:  # fmt: skip
    """Fill the row of a crossing at pixel (u, v) on the edge from vertex a to b; False: no length.

    The depth is that of the edge itself: the edge and the ray meet in the picture.
    """
    rx, ry = (u - middle) / focal, (v - middle) / focal
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
        return False
    # The outward image normal is (t_y, −t_x).
    facing = (ty * dx - tx * dy) / length
    sign = 1.0 if facing > 0.0 else -1.0
    z = 1.0 / w
    row[0], row[1] = u, v
    row[2], row[3], row[4] = rx * z, ry * z, z
    total = 0.0
    for k in range(3):
        row[5 + k] = sign * (vertices[b, k] - vertices[a, k])
        total += row[5 + k] ** 2
    total = np.sqrt(total)
    for k in range(3):
        row[5 + k] /= total
    row[KIND] = kind
    row[LENGTH] = abs(facing)
    return True


@njit(cache=True, nogil=True)
def edge_crossings(
    vertices: Array, points: Array, faces: Int32s, normals: Array, beside: Int32s, albedo: Array,
    focal: float, middle: float, nearness: Float32s, owner: Int32s, step: float,
) -> Array:  # fmt: skip
    """Every edge between neighbouring pixels: (M, 10) rows.

    Args:
        vertices: (V, 3), camera frame, and ``points``: (V, 2), their pixels.
        faces: (F, 3), with ``normals`` (F, 3), ``beside`` (F, 3) and ``albedo`` (F,).
        focal: px, and ``middle``: px, of both axes.
        nearness: (H, W) 1/z, and ``owner``: (H, W) visible face, −1 for the sky.
        step: m; a surface that much deeper is another surface.
    """
    height, width = owner.shape
    rows = np.empty((_ROWS, _COLUMNS))
    count = 0
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            face = owner[y, x]
            if face < 0:
                continue
            for side in range(4):
                dx, dy = (1, 0, -1, 0)[side], (0, 1, 0, -1)[side]
                if owner[y + dy, x + dx] == face:
                    continue
                kind = _edge_kind(
                    vertices, faces, normals, albedo, focal, middle, nearness, owner, step,
                    x, y, dx, dy,
                )  # fmt: skip
                if kind < 0:
                    continue
                enter, leave, edge = line_in_face(points, faces, face, x, y, dx, dy)
                if edge < 0 or enter > 0.5 or leave < -0.5:
                    continue
                last = face
                if kind != _CREASE:
                    last, leave, edge = _followed(
                        vertices, points, faces, normals, beside, focal, middle, nearness, owner,
                        step, x, y, dx, dy, face, leave, edge,
                    )  # fmt: skip
                if leave < -0.01 or leave > 1.01:
                    continue
                if count == rows.shape[0]:
                    grown = np.empty((2 * count, _COLUMNS))
                    grown[:count] = rows
                    rows = grown
                a, b = faces[last, edge], faces[last, (edge + 1) % 3]
                u, v = x + dx * leave, y + dy * leave
                if _write_crossing(rows[count], vertices, a, b, u, v, dx, dy, focal, middle, kind):
                    count += 1
    return rows[:count]
