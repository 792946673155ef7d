"""Levels of a picture: a large target is searched for in a smaller picture.

The ranges of the search are pixels, and its starting poses are off by a share of the target's
size. A target of a thousand pixels is therefore searched for where it has a few hundred. The pose
that is found is refined once more in a finer picture.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture, shrunk
from rendezview.sensors.appearance.edges.refinement import RefineOptions
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.level import Level
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky

# Px, radius of the largest target that is searched for in the picture itself. The stages were
# chosen with 100 to 220 px and hold up to here.
# Source: docs/notes/refinement.md, size of the target
LARGEST_RADIUS_PX = 350.0
# Px, the same for the last refinement: in larger ones the points of a view, up to 2.5° away, are
# off by more than its last stage looks. Source: docs/notes/refinement.md, size of the target
FINEST_RADIUS_PX = 700.0
# Rad; a refined pose further away is another one. Twenty times the error that the search leaves.
_MOST_APART_RAD = np.deg2rad(1.0)  # Source: docs/notes/refinement.md, size of the target
_MOST_TIMES = 32  # a target before the camera is never larger than that. Source: by construction
# Px², variance that reading adds to a blurred edge: a pixel is a box of 1/12, and reading between
# pixels a triangle of 1/6. Source: by construction
_READING_PX2 = 1.0 / 12.0 + 1.0 / 6.0


class Levels:
    """The levels at which poses of one model are searched for, in the frames of one camera."""

    def __init__(self, model: ViewModel, camera: Camera) -> None:
        self.model = model
        self.whole = Level.of(model, camera)
        self._levels = {1: self.whole}

    def with_camera(self, camera: Camera, options: RefineOptions | None = None) -> Levels:
        """Those of another camera; ``options`` of refinement: None for the own."""
        other = copy(self)
        other.whole = self.whole.with_camera(camera, options)
        other._levels = {1: other.whole}
        return other

    def start_at(self, angles_rad: Array, *, tracked: bool = False) -> None:
        """Joints start at these angles (J,) in the next frame; ``tracked``: from the last one."""
        for level in self._levels.values():
            if level.refiner.articulation is not None:
                level.refiner.articulation.start_rad = angles_rad.copy()
                level.refiner.articulation.tracked = tracked

    def at(
        self, image: Picture, sky: Sky, range_m: float, most_px: float = LARGEST_RADIUS_PX
    ) -> tuple[Level, Picture, Sky]:
        """The level, the picture and its sky for a target at some range."""
        whole, radius_m = self.whole, self.model.target_radius_m
        times = times_smaller(whole.camera, radius_m, range_m, most_px)
        if times == 1:
            return whole, image, sky
        if times not in self._levels:
            options = whole.refiner.options
            options = replace(options, blur_px=shrunk_blur(options.blur_px, times))
            self._levels[times] = whole.with_camera(whole.camera.binned(times), options)
        small = shrunk(image, times)
        return self._levels[times], small, shrunk_sky(small, sky)

    def range_m(self, pose: Pose) -> float:
        """Range of the view centre at a pose."""
        return float(np.linalg.norm(pose.apply(self.model.centre_m)))

    def finished(self, found: Found | None, image: Picture, sky: Sky) -> Found | None:
        """The same with the best pose refined in a finer picture.

        Its inlier ratios and its residual stay those of the level of the search, since the
        confidence is fitted to such sizes.
        """
        if found is None:
            return None
        pose = found.best.pose
        range_m = self.range_m(pose)
        searched, fine = (
            times_smaller(self.whole.camera, self.model.target_radius_m, range_m, most)
            for most in (LARGEST_RADIUS_PX, FINEST_RADIUS_PX)
        )
        if fine == searched:
            return found
        level, picture, its_sky = self.at(image, sky, range_m, FINEST_RADIUS_PX)
        refined = level.refiner.refine(picture, its_sky, pose, closely=True)
        if refined is None or refined.pose.angle_to(pose) > _MOST_APART_RAD:
            return found
        best = replace(
            found.best,
            pose=refined.pose,
            covariance=refined.covariance,
            angles_rad=refined.angles_rad,
            joint_covariance=refined.joint_covariance,
            joint_support=refined.joint_support,
        )
        return replace(found, best=best)


def times_smaller(
    camera: Camera, radius_m: float, range_m: float, most_px: float = LARGEST_RADIUS_PX
) -> int:
    """By how many times a picture is shrunk for a target's radius of ``most_px`` at most."""
    return min(_MOST_TIMES, max(1, math.ceil(radius_px(camera, radius_m, range_m) / most_px)))


def radius_px(camera: Camera, radius_m: float, range_m: float) -> float:
    """Radius of a target's picture, px."""
    return max(camera.fx, camera.fy) * radius_m / max(range_m, radius_m)


def shrunk_sky(image: Picture, sky: Sky) -> Sky:
    """Level and noise of a shrunk picture; dark and Sun are those of the whole one."""
    small = Sky.of(image)
    return Sky(small.level_grey, small.noise_grey, sky.dark, sky.sun_camera)


def edge_blur(optics_px: float) -> float:
    """The blur of an edge as it is read, one σ, from that of the picture."""
    return math.sqrt(optics_px**2 + _READING_PX2)


def shrunk_blur(blur_px: float, times: int) -> float:
    """The blur of an edge, one σ, in the pixels of a shrunk picture; as read in both."""
    optics_px2 = max(blur_px**2 - _READING_PX2, 0.0)
    return edge_blur(math.sqrt(optics_px2) / times)
