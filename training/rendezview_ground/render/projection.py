"""The picture plane of a training view, and the projection of vertices into it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose

Mask = npt.NDArray[np.uint8]
NEAREST_M = 1e-3  # m; least depth of a vertex in front of the camera's plane


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of an undistorted picture plane."""

    width: int
    height: int
    focal_px: float
    cx: float  # the boresight, in pixels from the centre of the top-left pixel
    cy: float


class SilhouetteRenderer(Protocol):
    """Draws silhouettes of one mesh."""

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        """(height, width) mask, 255 on the target.

        Raises:
            RendezviewError: a part of the target lies behind the camera's plane.
        """


class SurfaceRenderer(Protocol):
    """Draws the nearest surfaces of one mesh."""

    def draw_surfaces(
        self, camera_from_target: Pose, window: Window
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """(height, width) nearness in 1/m, 0 in the sky; and the face that is seen, −1 in the sky.

        A pixel shows what its centre meets.
        """


def project_vertices(
    vertices_m: Array, camera_from_target: Pose, window: Window, columns: int = 2
) -> Array:
    """Project vertices (V, 3) to (V, 2) pixels of the window; of 3 columns the last is 1/z, 1/m.

    Raises:
        RendezviewError: a vertex lies at or behind the camera's plane.
    """
    points_px = np.empty((len(vertices_m), columns))
    least = _project(
        vertices_m,
        camera_from_target.rotation,
        camera_from_target.translation_m,
        window.focal_px,
        window.cx,
        window.cy,
        points_px,
    )
    if not least > NEAREST_M:
        raise RendezviewError(
            "part of the target lies behind the camera: the camera is inside the target, "
            "use a larger sphere radius"
        )
    return points_px


@njit(cache=True, nogil=True, error_model="numpy")
def _project(
    vertices: Array,
    rotation: Array,
    translation: Array,
    focal: float,
    cx: float,
    cy: float,
    out: Array,
) -> float:
    """Pinhole projection into ``out`` (V, 2), or (V, 3) with 1/z; returns the least depth."""
    least = np.inf
    r = rotation
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + translation[2]
        least = min(least, depth)
        scale = focal / depth if depth > 0.0 else np.nan
        out[i, 0] = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + translation[0]) * scale + cx
        out[i, 1] = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + translation[1]) * scale + cy
        if out.shape[1] == 3:
            out[i, 2] = scale / focal
    return least
