"""The views of one model as compiled loops read them, and the projection of a contour point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.lens import distorted
from rendezview.geometry.pose import Array

Two = tuple[float, float]
Six = tuple[float, float, float, float, float, float]
Lens = tuple[Array, bool]  # ``lens_vector``, and whether the camera distorts

# Of normalised coordinates, for the derivative of the distortion.
_STEP = 1e-5  # Source: by construction, between rounding and curvature


class ViewTables(NamedTuple):
    """The sparse views of one model; see ``Contours``."""

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


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def through_lens(x: float, y: float, lens: Lens) -> Six:
    """Distorted coordinates of (x, y), and their derivatives m00, m01, m10, m11."""
    u, v = x, y
    m00, m01, m10, m11 = 1.0, 0.0, 0.0, 1.0
    if lens[1]:
        h = _STEP
        u, v = distorted(x, y, lens[0])
        u1, v1 = distorted(x + h, y, lens[0])
        u2, v2 = distorted(x, y + h, lens[0])
        m00, m10, m01, m11 = (u1 - u) / h, (v1 - v) / h, (u2 - u) / h, (v2 - v) / h
    return u, v, m00, m01, m10, m11
