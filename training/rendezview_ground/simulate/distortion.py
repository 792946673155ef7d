"""Simulation of lens distortion: a wider pinhole picture and the map from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s

_AREA_MAX = 9.0  # largest area of the wide picture, in areas of the camera's picture


@dataclass(frozen=True, slots=True, eq=False)
class Widened:
    """A pinhole camera that covers the view of a distorted one, and the map between them."""

    pinhole: Camera
    map_x: Float32s  # (H, W) column in the wide picture for each pixel
    map_y: Float32s  # (H, W) row

    def bend(self, wide: Float32s, interpolation: int, outside: float = 0.0) -> Float32s:
        """Distort the wide picture (h, w) to the camera's (H, W)."""
        bent = cv2.remap(
            wide,
            self.map_x,
            self.map_y,
            interpolation,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=outside,
        )
        return np.asarray(bent, dtype=np.float32)


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera) -> Array:
    """Ray of every pixel centre, (H, W, 3), z = 1; read-only."""
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    points_px = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    rays = np.asarray(camera.rays(points_px)).reshape(camera.height, camera.width, 3)
    rays.setflags(write=False)
    return rays


@lru_cache(maxsize=4)
def widened(camera: Camera) -> Widened | None:
    """The wide pinhole camera for a distorted one; None without distortion.

    Raises:
        RendezviewError: the corner rays are too oblique, or cannot be computed.
    """
    if not camera.is_distorted:
        return None
    rays = pixel_rays(camera)
    x, y = rays[..., 0], rays[..., 1]
    if np.isfinite(rays).all():
        left, right = math.floor(camera.fx * x.min()) - 2, math.ceil(camera.fx * x.max()) + 2
        top, bottom = math.floor(camera.fy * y.min()) - 2, math.ceil(camera.fy * y.max()) + 2
        width, height = right - left + 1, bottom - top + 1
        if width * height <= _AREA_MAX * camera.width * camera.height:
            return Widened(
                Camera(width, height, camera.fx, camera.fy, -float(left), -float(top)),
                (camera.fx * x - left).astype(np.float32),
                (camera.fy * y - top).astype(np.float32),
            )
    raise RendezviewError(
        f"the camera's distortion {tuple(camera.distortion)} bends the corners of its picture "
        "too far to simulate: check the coefficients, or simulate a camera without distortion"
    )
