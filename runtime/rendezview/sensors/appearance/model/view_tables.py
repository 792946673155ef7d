"""The views of one model as compiled loops read them, and the projection of a contour point."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.lens import distorted
from rendezview.geometry.pose import Array

Kind = TypeVar("Kind", bound=np.generic)
Two = tuple[float, float]
Six = tuple[float, float, float, float, float, float]
Lens = tuple[Array, bool]  # ``lens_vector``, and whether the camera distorts

# Of normalised coordinates, for the derivative of the distortion.
LENS_STEP = 1e-5  # Source: by construction, between rounding and curvature
# m; a point must lie before the camera.
LEAST_DEPTH_M = 1e-6  # Source: by construction, no division by 0
# px, of an edge's projection; a shorter one has no normal. Source: by construction, the same
LEAST_LENGTH = 1e-9


class ViewTables(NamedTuple):
    """The sparse views of one model, ``read_only``; see ``Contours``."""

    directions: Array
    shells_m: Array
    point: npt.NDArray[np.int16]
    tangent: npt.NDArray[np.int8]
    kind: npt.NDArray[np.uint8]
    run: npt.NDArray[np.uint8]
    strip: npt.NDArray[np.uint8]
    start: npt.NDArray[np.int8]
    palette: npt.NDArray[np.float32]
    radius_m: float
    blur_px: float
    shape_error: float


def read_only(table: npt.NDArray[Kind]) -> npt.NDArray[Kind]:
    """A table as all loops have it: one that may be written would be compiled for again."""
    shown = np.ascontiguousarray(table).view()
    shown.flags.writeable = False
    return shown


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def through_lens(x: float, y: float, lens: Lens) -> Six:
    """Distorted coordinates of (x, y), and their derivatives m00, m01, m10, m11."""
    u, v = x, y
    m00, m01, m10, m11 = 1.0, 0.0, 0.0, 1.0
    if lens[1]:
        h = LENS_STEP
        u, v = distorted(x, y, lens[0])
        u1, v1 = distorted(x + h, y, lens[0])
        u2, v2 = distorted(x, y + h, lens[0])
        m00, m10, m01, m11 = (u1 - u) / h, (v1 - v) / h, (u2 - u) / h, (v2 - v) / h
    return u, v, m00, m01, m10, m11


class ProjectedEdge(NamedTuple):
    """Where a pose puts an edge in the picture; all 0 where it has no place there."""

    is_visible: bool  # before the camera, and not along the line of sight
    u: float  # pixels
    v: float
    nx: float  # unit normal, outwards
    ny: float
    gx: float  # derivative of a place along the normal with x, pixels
    gy: float
    x: float  # normalised coordinates
    y: float
    inverse: float  # of the depth, 1/m
    qx: float  # from the view centre, m, camera axes
    qy: float
    qz: float


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def project_edge(
    px: float, py: float, pz: float, tangent: npt.NDArray[np.int8], lens: Lens, rotation: Array,
    centre: Array,
) -> ProjectedEdge:  # fmt: skip
    """The projection of an edge through a point, target axes at the view centre, m."""
    qx = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
    qy = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
    qz = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
    depth = qz + centre[2]
    if depth <= LEAST_DEPTH_M:
        return ProjectedEdge(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    inverse = 1.0 / depth
    x, y = (qx + centre[0]) * inverse, (qy + centre[1]) * inverse
    t0, t1, t2 = tangent[0], tangent[1], tangent[2]
    tz = rotation[2, 0] * t0 + rotation[2, 1] * t1 + rotation[2, 2] * t2
    ax = rotation[0, 0] * t0 + rotation[0, 1] * t1 + rotation[0, 2] * t2 - x * tz
    ay = rotation[1, 0] * t0 + rotation[1, 1] * t1 + rotation[1, 2] * t2 - y * tz
    u, v, m00, m01, m10, m11 = through_lens(x, y, lens)
    camera = lens[0]
    fx, fy = camera[0], camera[1]
    bx, by = fx * (m00 * ax + m01 * ay), fy * (m10 * ax + m11 * ay)
    length = np.sqrt(bx * bx + by * by)
    if length < LEAST_LENGTH:  # the edge runs along the line of sight
        return ProjectedEdge(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    nx, ny = by / length, -bx / length
    gx, gy = nx * fx * m00 + ny * fy * m10, nx * fx * m01 + ny * fy * m11
    u, v = fx * u + camera[2], fy * v + camera[3]
    return ProjectedEdge(True, u, v, nx, ny, gx, gy, x, y, inverse, qx, qy, qz)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def pose_slope_into(edge: ProjectedEdge, out: Array) -> None:
    """Fill ``out`` (6,), the derivative of a place along the normal with the pose.

    Rotation about the view centre, rad, then translation, m; camera axes, left.
    """
    j0, j1 = edge.gx * edge.inverse, edge.gy * edge.inverse
    j2 = -(edge.gx * edge.x + edge.gy * edge.y) * edge.inverse
    out[0] = j2 * edge.qy - j1 * edge.qz
    out[1] = j0 * edge.qz - j2 * edge.qx
    out[2] = j1 * edge.qx - j0 * edge.qy
    out[3], out[4], out[5] = j0, j1, j2
