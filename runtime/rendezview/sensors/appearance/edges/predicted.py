"""Where a pose puts the contour points of a view: the rows that measurements fill in.

Most of a search is spent on such rows. Those of a view are made in one loop without branches and
slices, of which the compiler makes vectors: six times as fast as one by one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.lens import is_polynomial, polynomial
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.contours import NO_POINT
from rendezview.sensors.appearance.model.view_tables import (
    LEAST_DEPTH_M,
    LEAST_LENGTH,
    LENS_STEP,
    Lens,
    ProjectedEdge,
    Six,
    through_lens,
)

# Columns of the measurements: six of the Jacobian of the residual (rotation about the view
# centre, rad, translation, m, camera axes, left), then these. N is the normal, outwards.
RESIDUAL, WEIGHT, STATE, U, V, NX, NY = 6, 7, 8, 9, 10, 11, 12
COLUMNS = 13  # Source: by construction
FOUND, NOT_FOUND, OUTSIDE, CROWDED = 1.0, 0.0, -1.0, -2.0  # STATE of a point


@njit(cache=True, nogil=True, error_model="numpy")
def predict_edges(
    point: npt.NDArray[np.int16], tangent: npt.NDArray[np.int8], count: int, stride: int,
    lens: Lens, unit_m: float, rotation: Array, centre: Array, rows: Array,
) -> None:  # fmt: skip
    """Fill the rows of every so many-th contour point: Jacobian, state, place and normal.

    The state is NOT_FOUND, or OUTSIDE where a point has no place in the picture.

    Args:
        point: (N, 3) of a view, ``unit_m`` metres each; ``tangent``: (N, 3); the first ``count``.
        lens: ``lens_vector`` of the camera, and whether it distorts.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        rows: (≥ N, COLUMNS); the others are left as they are.
    """
    camera, plain = lens[0], not lens[1] or is_polynomial(lens[0])
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    c0, c1, c2 = centre[0], centre[1], centre[2]
    for k in range((count + stride - 1) // stride):
        j = k * stride
        px, py, pz = unit_m * point[j, 0], unit_m * point[j, 1], unit_m * point[j, 2]
        t0, t1, t2 = tangent[j, 0], tangent[j, 1], tangent[j, 2]
        qx = r00 * px + r01 * py + r02 * pz
        qy = r10 * px + r11 * py + r12 * pz
        qz = r20 * px + r21 * py + r22 * pz
        depth = qz + c2
        inverse = 1.0 / max(depth, LEAST_DEPTH_M)
        x, y = (qx + c0) * inverse, (qy + c1) * inverse
        tz = r20 * t0 + r21 * t1 + r22 * t2
        ax = r00 * t0 + r01 * t1 + r02 * t2 - x * tz
        ay = r10 * t0 + r11 * t1 + r12 * t2 - y * tz
        u, v, m00, m01, m10, m11 = _through_polynomial(x, y, camera)
        if not plain:
            u, v, m00, m01, m10, m11 = through_lens(x, y, lens)
        bx, by = fx * (m00 * ax + m01 * ay), fy * (m10 * ax + m11 * ay)
        length = np.sqrt(bx * bx + by * by)
        nx, ny = by / max(length, LEAST_LENGTH), -bx / max(length, LEAST_LENGTH)
        j0 = inverse * (nx * fx * m00 + ny * fy * m10)
        j1 = inverse * (nx * fx * m01 + ny * fy * m11)
        j2 = -(j0 * x + j1 * y)
        rows[j, 0] = j2 * qy - j1 * qz
        rows[j, 1] = j0 * qz - j2 * qx
        rows[j, 2] = j1 * qx - j0 * qy
        rows[j, 3], rows[j, 4], rows[j, 5] = j0, j1, j2
        rows[j, U], rows[j, V] = fx * u + cx, fy * v + cy
        rows[j, NX], rows[j, NY] = nx, ny
        visible = depth > LEAST_DEPTH_M and length >= LEAST_LENGTH
        rows[j, STATE] = NOT_FOUND if visible else OUTSIDE


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def edge_of_row(
    row: Array, px: float, py: float, pz: float, rotation: Array, centre: Array
) -> ProjectedEdge:
    """The projection of an edge through a point, from its row: the lens need not be asked again."""
    qx = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
    qy = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
    qz = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
    depth = qz + centre[2]
    inverse = 1.0 / depth
    x, y = (qx + centre[0]) * inverse, (qy + centre[1]) * inverse
    gx, gy = row[3] * depth, row[4] * depth
    return ProjectedEdge(True, row[U], row[V], row[NX], row[NY], gx, gy, x, y, inverse, qx, qy, qz)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _through_polynomial(x: float, y: float, camera: Array) -> Six:
    """``through_lens`` where ``is_polynomial``, without branches."""
    h = LENS_STEP
    u, v = polynomial(x, y, camera)
    u1, v1 = polynomial(x + h, y, camera)
    u2, v2 = polynomial(x, y + h, camera)
    return u, v, (u1 - u) / h, (u2 - u) / h, (v1 - v) / h, (v2 - v) / h


@njit(cache=True, nogil=True, error_model="numpy")
def point_count(kind: npt.NDArray[np.uint8]) -> int:
    """Points of a view; rows without one stand last."""
    for j in range(kind.shape[0]):
        if kind[j] == NO_POINT:
            return j
    return kind.shape[0]  # type: ignore[no-any-return]
