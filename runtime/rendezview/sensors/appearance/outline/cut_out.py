"""The part of a frame around the target, in fewer pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture, shrunk
from rendezview.sensors.appearance.outline.silhouette import Silhouette

_AROUND = 1.1  # of the bounding sphere's picture. Source: by construction, some sky is left
# Px; a picture is not halved below that width. Source: 75 frames of tree-ablation (0.1), hubble,
# seed 4205: 96 % of the active nodes are those of the whole frame, with half as many 90 %
_LEAST_SIDE_PX = 192
_NEAREST_RADII = 1.2  # target radii; nearer, the sphere has no picture. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class CutOut:
    """A part of a frame, each of whose pixels is the mean of a square of the frame's."""

    picture: Picture
    corner_px: tuple[int, int]  # x, y of the frame: its upper left pixel
    times: int  # pixels of the frame along the side of one of its own
    centre_px: Array  # (2,) of the picture: where the middle of the target is expected

    @classmethod
    def whole(cls, frame: Picture, centre_px: Array) -> CutOut:
        """The frame itself."""
        return cls(frame, (0, 0), 1, centre_px)

    @classmethod
    def about(cls, frame: Picture, camera: Camera, centre_m: Array, radius_m: float) -> CutOut:
        """The square around a sphere, or the whole frame where the sphere is too near for that.

        Args:
            frame: (H, W) of the camera's size.
            camera: that took it.
            centre_m: (3,) of the sphere, camera frame.
            radius_m: of the sphere.
        """
        centre_px = camera.project(centre_m)
        right_m, down_m, depth_m = centre_m.tolist()
        if depth_m < _NEAREST_RADII * radius_m:
            return cls.whole(frame, centre_px)
        height, width = frame.shape
        focal = max(camera.fx, camera.fy)
        aside = 1.0 + (right_m**2 + down_m**2) / depth_m**2  # off the boresight
        half = _AROUND * aside * focal * radius_m / math.sqrt(depth_m**2 - radius_m**2)
        u, v = centre_px.tolist()
        left, top = max(0, int(u - half)), max(0, int(v - half))
        right, bottom = min(width, int(u + half) + 2), min(height, int(v + half) + 2)
        times = 1
        while min(right - left, bottom - top) >= 2 * times * _LEAST_SIDE_PX:
            times *= 2
        across, down = (right - left) // times, (bottom - top) // times
        if across < 1 or down < 1:
            return cls.whole(frame, centre_px)
        part = frame[top : top + down * times, left : left + across * times]
        inside_px = (centre_px - (left, top) + 0.5) / times - 0.5
        return cls(np.ascontiguousarray(shrunk(part, times)), (left, top), times, inside_px)

    def in_frame(self, found: Silhouette) -> Silhouette:
        """A silhouette of this picture in the pixels of the frame."""
        return found.enlarged(self.times).moved(*self.corner_px)
