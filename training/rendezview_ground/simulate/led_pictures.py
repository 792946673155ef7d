"""The same laboratory with two picture cameras instead of the photodiodes.

Lights are round Gaussian spots. The signal-to-noise ratio is defined as in the paper: the
largest signal of the sensor, here the peak of a spot above the sky, over the r.m.s. noise of one
pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons import Lens, Rig
from rendezview_ground.simulate.led_laboratory import Laboratory

_REACH = 5.0  # σ; extent of a drawn spot


def picture_rig(laboratory: Laboratory, options: PictureOptions) -> Rig:
    """The laboratory's cameras with a pixel detector of the same size and a perfect lens."""
    pitch = 2.0 * laboratory.options.half_width_m / options.size_px
    middle = 0.5 * (options.size_px - 1)
    return Rig(
        tuple(
            replace(
                camera, fx=camera.fx / pitch, fy=camera.fy / pitch, cx=middle, cy=middle,
                lens=Lens(), photodiode=None, size=(options.size_px, options.size_px),
            )
            for camera in laboratory.rig.cameras
        )
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Two cameras with the photodiodes' field of view."""

    size_px: int = 1024
    peak_grey: float = 200.0  # above the sky
    sky_grey: float = 20.0
    signal_to_noise: float = 200.0
    spot_sigma_px: float = 1.5

    @property
    def noise_grey(self) -> float:
        """R.m.s. noise of a pixel before it is rounded."""
        return self.peak_grey / self.signal_to_noise


def draw(
    rig: Rig,
    camera: int,
    points_rig_m: Array,
    options: PictureOptions,
    rng: np.random.Generator,
    scene: npt.NDArray[np.float32] | None = None,
) -> npt.NDArray[np.uint8]:
    """One picture of lights (N, 3), rig frame; lights outside the picture are ignored.

    A ``scene`` (H, W) adds grey levels to the sky.
    """
    width, height = rig.cameras[camera].size or (0, 0)
    noise = rng.standard_normal((height, width), dtype=np.float32)
    grey = options.sky_grey + options.noise_grey * noise
    if scene is not None:
        grey += scene
    s = options.spot_sigma_px
    for u, v in rig.cameras[camera].project(points_rig_m):
        if not (math.isfinite(u) and math.isfinite(v)):
            continue
        left, right = max(int(u - _REACH * s), 0), min(int(u + _REACH * s) + 2, width)
        top, bottom = max(int(v - _REACH * s), 0), min(int(v + _REACH * s) + 2, height)
        if left >= right or top >= bottom:
            continue
        x = np.exp(-0.5 * ((np.arange(left, right) - u) / s) ** 2)
        y = np.exp(-0.5 * ((np.arange(top, bottom) - v) / s) ** 2)
        grey[top:bottom, left:right] += options.peak_grey * np.outer(y, x)
    return np.asarray(np.clip(np.rint(grey), 0.0, 255.0), dtype=np.uint8)
