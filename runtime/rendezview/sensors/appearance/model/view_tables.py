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
