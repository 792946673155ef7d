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
from rendezview.geometry.zbuffer import Float32s, Int32s
from rendezview_ground.mesh.mesh import Mesh

STEP_RADII = 0.02  # target radii; a surface that much deeper is another surface
_CREASE_COSINE = np.cos(np.deg2rad(30.0))  # facets that meet at a greater angle form a crease
_FAINT_COLOUR = 0.12  # albedo; facets that differ by more form a crease, too
_OUTLINE, _STEP, _CREASE = 0, 1, 2  # kinds of edges: against the sky, in depth, in normal or albedo
# Columns of a crossing: u v, point (3), tangent (3), then
KIND, LENGTH = 8, 9  # kind of the edge; length of the outline that it represents, px
FACE = 10  # whose edge it is
_COLUMNS = 11


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


@njit(cache=True, nogil=True, error_model="numpy")
def face_normals(vertices: Array, faces: Int32s) -> Array:
    """Unit normals (F, 3) towards the camera; (0, 0, −1) for a face without area."""
    normals = np.empty((faces.shape[0], 3))
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        px, py, pz = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        ax, ay, az = vertices[j, 0] - px, vertices[j, 1] - py, vertices[j, 2] - pz
        bx, by, bz = vertices[k, 0] - px, vertices[k, 1] - py, vertices[k, 2] - pz
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        if length < 1e-30:
            x, y, z, length = 0.0, 0.0, -1.0, 1.0
        elif x * px + y * py + z * pz > 0.0:
            length = -length
        normals[f, 0], normals[f, 1], normals[f, 2] = x / length, y / length, z / length
    return normals


@njit(cache=True, nogil=True, error_model="numpy")
def depth_on(
    vertices: Array, faces: Int32s, face: int, normals: Array, rx: float, ry: float
) -> float:
    """Depth z where the ray (rx, ry, 1) meets the plane of a face; 0 for a parallel ray."""
    a = faces[face, 0]
    nx, ny, nz = normals[face, 0], normals[face, 1], normals[face, 2]
    down = nx * rx + ny * ry + nz
    if abs(down) < 1e-9:
        return 0.0
    return (nx * vertices[a, 0] + ny * vertices[a, 1] + nz * vertices[a, 2]) / down  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _is_step(
    vertices: Array, faces: Int32s, normals: Array, focal: float, middle: float, face: int,
    near: float, other: float, step: float, x: int, y: int,
) -> bool:  # fmt: skip
    """Whether the nearer face, prolonged to the pixel (x, y) beside it, stays before what is there.

    ``near`` and ``other`` are 1/z of both; they differ by more than a step in depth.
    """
    rx, ry = (x - middle) / focal, (y - middle) / focal
    z = depth_on(vertices, faces, face, normals, rx, ry)
    return 1.0 / other - 1.0 / near > step and (z <= 0.0 or 1.0 / other - z > step)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


def edge_pixels(
    vertices: Array, faces: Int32s, normals: Array, albedo: Array, focal: float, middle: float,
    nearness: Float32s, owner: Int32s, step: float,
) -> tuple[Int32s, npt.NDArray[np.bool_]]:  # fmt: skip
    """The pixels beside an edge, and (H, W) whether a pixel is one of them.

    An outline belongs to the target, a step to the nearer surface, a crease to its left or upper
    pixel.

    Args:
        vertices: (V, 3), camera frame.
        faces: (F, 3), with ``normals`` (F, 3) and ``albedo`` (F,).
        focal, middle, nearness, owner, step: as of ``edge_crossings``.

    Returns:
        (M, 4) column, row, side on which the edge lies (0 right, 1 below, 2 left, 3 above), kind.
    """
    look = np.column_stack([normals, albedo]).astype(np.float32)
    marks = np.zeros(owner.shape, dtype=np.bool_)
    rows = np.empty((2 * owner.size, 4), dtype=np.int32)  # memory that is not filled costs none
    count = _borders(owner, rows)
    count = _kept_edges(
        vertices, faces, normals, look, focal, middle, nearness, owner, step, rows[:count], marks
    )
    return rows[:count], marks


@njit(cache=True, nogil=True, error_model="numpy")
def _borders(owner: Int32s, rows: Int32s) -> int:
    """List the pixels (x, y, 0) beside another face on the right, (x, y, 1) below; how many."""
    count = 0
    for y in range(1, owner.shape[0] - 1):
        here, under = owner[y], owner[y + 1]
        for x in range(1, owner.shape[1] - 1):
            right, below = here[x] != here[x + 1], here[x] != under[x]
            if not (right or below):
                continue
            for down in range(1 - right, 1 + below):
                rows[count, 0], rows[count, 1], rows[count, 2] = x, y, down
                count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _kept_edges(
    vertices: Array, faces: Int32s, normals: Array, look: Float32s, focal: float, middle: float,
    nearness: Float32s, owner: Int32s, step: float, rows: Int32s, marks: npt.NDArray[np.bool_],
) -> int:  # fmt: skip
    """Keep the ``rows`` of `_borders` that are edges, and mark their pixels; how many.

    ``look`` (F, 4) holds normals and albedo: most neighbours differ in neither.
    """
    count = 0
    for k in range(rows.shape[0]):
        x, y, down = rows[k, 0], rows[k, 1], rows[k, 2]
        dx, dy = 1 - down, down
        face, beyond = owner[y, x], owner[y + dy, x + dx]
        next_one = False
        if face < 0 or beyond < 0:
            kind, next_one = _OUTLINE, face < 0
        else:
            near, other = nearness[y, x], nearness[y + dy, x + dx]
            if abs(near - other) <= step * near * other:
                cosine = look[face, 0] * look[beyond, 0]
                cosine += look[face, 1] * look[beyond, 1]
                cosine += look[face, 2] * look[beyond, 2]
                paint = abs(look[face, 3] - look[beyond, 3])
                if cosine > _CREASE_COSINE and paint < _FAINT_COLOUR:
                    continue
                kind = _CREASE
            else:
                kind, next_one = _STEP, other > near
                if next_one:
                    is_step = _is_step(vertices, faces, normals, focal, middle, beyond,
                                       other, near, step, x, y)  # fmt: skip
                else:
                    is_step = _is_step(vertices, faces, normals, focal, middle, face,
                                       near, other, step, x + dx, y + dy)  # fmt: skip
                if not is_step:
                    continue
        u, v = (x + dx, y + dy) if next_one else (x, y)
        marks[v, u] = True
        rows[count, 0], rows[count, 1] = u, v
        rows[count, 2], rows[count, 3] = down + 2 * next_one, kind
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def edge_crossings(
    vertices: Array, points: Array, faces: Int32s, normals: Array, beside: Int32s, pixels: Int32s,
    focal: float, middle: float, nearness: Float32s, owner: Int32s, step: float,
) -> Array:  # fmt: skip
    """Where the edges beside some pixels cross the lines to their neighbours: (M, 11) rows.

    Args:
        vertices: (V, 3), camera frame, and ``points``: (V, 2) or more, their pixels.
        faces: (F, 3), with ``normals`` (F, 3) and ``beside`` (F, 3).
        pixels: (N, 4) of ``edge_pixels``.
        focal: px, and ``middle``: px, of both axes.
        nearness: (H, W) 1/z, and ``owner``: (H, W) visible face, −1 for the sky.
        step: m; a surface that much deeper is another surface.
    """
    rows = np.empty((pixels.shape[0], _COLUMNS))
    count = 0
    for k in range(pixels.shape[0]):
        x, y, side, kind = pixels[k, 0], pixels[k, 1], pixels[k, 2], pixels[k, 3]
        dx, dy = (1, 0, -1, 0)[side], (0, 1, 0, -1)[side]
        last = owner[y, x]
        enter, leave, edge = line_in_face(points, faces, last, x, y, dx, dy)
        if edge < 0 or enter > 0.5 or leave < -0.5:
            continue
        if kind != _CREASE:
            last, leave, edge = _followed(
                vertices, points, faces, normals, beside, focal, middle, nearness, owner,
                step, x, y, dx, dy, last, leave, edge,
            )  # fmt: skip
        if leave < -0.01 or leave > 1.01:
            continue
        a, b = faces[last, edge], faces[last, (edge + 1) % 3]
        u, v = x + dx * leave, y + dy * leave
        if _write_crossing(rows[count], vertices, a, b, u, v, dx, dy, focal, middle, kind):
            rows[count, FACE] = last
            count += 1
    return rows[:count]
