"""Refinement of a target that overflows the picture, next to a prior, on views of its near part.

Only the contour points in the picture count. No outline of the whole is needed, and no attitude is
searched for: without a prior there is no pose from so near.
"""

from __future__ import annotations

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.confidence import Found
from rendezview.sensors.appearance.edges.refinement import Refined, RefineOptions, Refiner
from rendezview.sensors.appearance.edges.starts import rotated_about_axes
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.sky import Sky

# Share of the lit contour points in the picture with an edge in place: right poses have 0.54 or
# more, wrong ones 0.34 or less. Source: experiment close-in, seeds 5 (Mitsuba) and 7
_LEAST_SHARE = 0.45
_LEAST_POINTS = 40  # in the picture. Source: experiment close-in, seed 7
# Rad, and of the range: a pose further from the prior is another one. A ring of 72 facets fits
# again when it is turned by 5°. Source: experiment close-in, seed 1
_FURTHEST_RAD = np.deg2rad(2.5)
_FURTHEST_RANGE = 0.05  # Source: by hand; a frame's way at half the speed of an approach
# Rad, one σ of the attitude: beside a ring alone, the prior knows more of the roll. Source: as
# above
_MOST_SIGMA_RAD = np.deg2rad(0.5)
_STARTS_RAD = np.deg2rad(2.0)  # around the prior, where it leads nowhere. Source: as ``near``
_KEPT = 2  # of the starts that are refined. Source: by hand


class CloseSearch:
    """Finds poses of a near part of one target in the frames of one camera."""

    def __init__(self, model: ViewModel, camera: Camera) -> None:
        self.model = model
        self._spheres = [
            (sphere, Refiner(model, camera, RefineOptions(), sphere)) for sphere in model.near
        ]

    def refiner(self, prior: Pose) -> Refiner | None:
        """Of the smallest sphere whose views serve for a pose; None: none does."""
        served = [(s.radius_m, k) for k, (s, _) in enumerate(self._spheres) if s.serves(prior)]
        return self._spheres[min(served)[1]][1] if served else None

    def at(self, image: Picture, sky: Sky, prior: Pose, enough_inliers: float) -> Found | None:
        """The pose next to a prior that is right to two degrees; None unless it is confident.

        Poses around the prior are tried too, unless the one next to it has ``enough_inliers``.
        """
        refiner = self.refiner(prior)
        if refiner is None:
            return None
        refined = refiner.refine(image, sky, prior)
        near = [] if refined is None or not self._trusted(refined, prior) else [refined]
        single = bool(near) and near[0].inlier_ratio >= enough_inliers
        if not single:
            starts = (prior, *rotated_about_axes(prior, refiner.centre_m, _STARTS_RAD))
            rotations = np.array([start.rotation for start in starts])
            centres = np.array([start.apply(refiner.centre_m) for start in starts])
            found = refiner.best(image, sky, rotations, centres, _KEPT)
            near += [r for r in found if self._trusted(r, prior)]
        if not near:
            return None
        best = max(near, key=lambda r: r.inlier_ratio)
        return Found(
            best, 0.0, 1.0, sky.dark, prior=True, single=single, error_model=refiner.error_model
        )

    def _trusted(self, refined: Refined, prior: Pose) -> bool:
        """Whether the edges confirm a pose, and it is the one that the prior means."""
        covariance = refined.covariance
        apart_m = np.linalg.norm(refined.pose.translation_m - prior.translation_m)
        return bool(
            refined.inlier_ratio >= _LEAST_SHARE
            and refined.points >= _LEAST_POINTS
            and np.linalg.eigvalsh(covariance[:3, :3])[-1] < _MOST_SIGMA_RAD**2
            and refined.pose.angle_to(prior) < _FURTHEST_RAD
            and apart_m < _FURTHEST_RANGE * np.linalg.norm(prior.translation_m)
        )
