"""A camera's pinhole and lens for compiled loops; `Camera` has the same for arrays."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array


def lens_vector(camera: Camera) -> Array:
    """(12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 of a camera."""
    distortion = (*camera.distortion, *([0.0] * 8))[:8]
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *distortion])


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def distorted(x: float, y: float, lens: Array) -> tuple[float, float]:
    """OpenCV's distortion of normalised coordinates; ``lens`` (≥ 12,) of ``lens_vector``."""
    r2 = x * x + y * y
    radial = (1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))) / (
        1.0 + r2 * (lens[9] + r2 * (lens[10] + r2 * lens[11]))
    )
    return (
        x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x),
        y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y,
    )
