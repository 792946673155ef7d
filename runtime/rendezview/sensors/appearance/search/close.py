"""Refinement of a target that overflows the picture, next to a prior, on views of its near part.

Only the contour points in the picture count. No outline of the whole is needed, and no attitude is
searched for: without a prior there is no pose from so near.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rendezview.estimation.hypotheses import best_by
from rendezview.geometry import so3
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.refinement import RefineOptions, Refiner
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.search.starts import rotated_about_axes, rotated_by
from rendezview.sensors.appearance.sky import Sky

# Share of the lit contour points in the picture with an edge in place: right poses have 0.54 or
# more, wrong ones 0.34 or less. Source: experiment close-in (0.1), seeds 5 (Mitsuba) and 7
_LEAST_SHARE = 0.45
_LEAST_POINTS = 40  # in the picture. Source: experiment close-in (0.1), seed 7
# Rad, and of the range: a pose further from the prior is another one. A ring of 72 facets fits
# again when it is turned by 5°, or by less. Source: experiment close-in (0.1), seed 1
_FURTHEST_RAD = np.deg2rad(2.5)
_FURTHEST_RANGE = 0.05  # Source: by hand, a frame of an approach
# Rad, one σ of the attitude: beside a ring alone, the prior knows more of the roll. Source: as
# above
_MOST_SIGMA_RAD = np.deg2rad(0.5)
_STARTS_RAD = np.deg2rad(2.0)  # around the prior, where it leads nowhere. Source: by hand
# Of the range: a pose may be so much nearer or farther where none is next to the prior. Source: by
# hand; an approach without known rates, or unseen for seconds
_MOST_RANGE = 0.15
_RANGE_STEP = 0.04  # of the range, between starts. Source: 20 px at the edge of a picture
_KEPT = 2  # of the starts that are refined. Source: by hand
# In the picture; with more no turned pose fits as well. Source: client, 210 frames at 5–1.5 m
_MANY_POINTS = 100
_AS_WELL = 2.0  # σ of the difference of two shares: less tells nothing. Source: by construction


class CloseSearch:
    """Finds poses of a near part of one target in the frames of one camera."""

    def __init__(self, model: ViewModel, camera: Camera) -> None:
        smallest_first = sorted(model.near, key=lambda sphere: sphere.radius_m)
        self._spheres = [(s, Refiner(model, camera, RefineOptions(), s)) for s in smallest_first]

    def refiner(self, prior: Pose) -> Refiner | None:
        """Of the smallest sphere whose views serve for a pose; None: none does."""
        return next((r for sphere, r in self._spheres if sphere.serves(prior)), None)

    def at(self, image: Picture, sky: Sky, prior: Pose, enough_inliers: float) -> Found | None:
        """The pose next to a prior that is right to two degrees; None unless it is confident.

        Poses around the prior are tried too, unless the one next to it has ``enough_inliers``;
        where there is none, nearer and farther ones as well.
        """
        refiner = self.refiner(prior)
        if refiner is None:
            return None
        found = _with_turned(refiner, image, sky, refiner.refine(image, sky, prior))
        best = _weighed(found, prior, _FURTHEST_RANGE)
        single = best is not None and best.inlier_ratio >= enough_inliers
        if not single:
            starts = rotated_about_axes(prior, refiner.centre_m, _STARTS_RAD)
            known = any(_trusted(one, prior, _FURTHEST_RANGE) for one in found)
            range_error = _FURTHEST_RANGE if known else _MOST_RANGE
            steps = int((range_error - _FURTHEST_RANGE) / _RANGE_STEP + 0.5)
            scales = 1.0 + _RANGE_STEP * np.arange(-steps, steps + 1)
            rotations = np.array([start.rotation for start in starts for _ in scales])
            centres = np.array(
                [scale * start.apply(refiner.centre_m) for start in starts for scale in scales]
            )
            for other in refiner.best(image, sky, rotations, centres, _KEPT):
                found += _with_turned(refiner, image, sky, other)
            best = _weighed(found, prior, range_error)
        if best is None:
            return None
        return Found(best, 1.0, sky.dark, prior=True, single=single)


def _with_turned(
    refiner: Refiner, image: Picture, sky: Sky, pose: Hypothesis | None
) -> list[Hypothesis]:
    """A pose, and those on both sides of it in the direction that its edges know least.

    The edges at a pose tell how far it may move on them, not that others fit as well: a ring alone
    does at every few degrees.
    """
    if pose is None or pose.covariance is None:
        return []
    if pose.points > _MANY_POINTS:
        return [pose]
    axis = np.linalg.eigh(pose.covariance[:3, :3])[1][:, -1] @ pose.pose.rotation
    turns = np.array([so3.exp(angle * axis) for angle in (-_FURTHEST_RAD, _FURTHEST_RAD)])
    found = [pose]
    for start in rotated_by(pose.pose, turns, refiner.centre_m):
        turned = refiner.refine(image, sky, start)
        if turned is not None:
            found.append(turned)
    return found


def _weighed(found: list[Hypothesis], prior: Pose, range_error: float) -> Hypothesis | None:
    """The best trusted pose, with a covariance that holds all that fit as well; None: too wide."""
    trusted = [one for one in found if _trusted(one, prior, range_error)]
    best = best_by(lambda one: one.inlier_ratio, trusted)
    if best is None or best.covariance is None:
        return None
    covariance = best.covariance.copy()
    for other in found:
        shares = (best.inlier_ratio, best.points), (other.inlier_ratio, max(other.points, 1))
        spread = sum(share * (1.0 - share) / points for share, points in shares)
        if other.inlier_ratio > best.inlier_ratio - _AS_WELL * np.sqrt(spread):
            apart = other.pose.delta_from(best.pose)
            covariance += np.outer(apart, apart)
    best = replace(best, covariance=covariance)
    return best if _trusted(best, prior, range_error) else None


def _trusted(refined: Hypothesis, prior: Pose, range_error: float) -> bool:
    """Whether the edges confirm a pose, and it is the one that the prior means."""
    assert refined.covariance is not None
    apart_m = np.linalg.norm(refined.pose.translation_m - prior.translation_m)
    return bool(
        refined.inlier_ratio >= _LEAST_SHARE
        and refined.points >= _LEAST_POINTS
        and np.linalg.eigvalsh(refined.covariance[:3, :3])[-1] < _MOST_SIGMA_RAD**2
        and refined.pose.angle_to(prior) < _FURTHEST_RAD
        and apart_m < range_error * np.linalg.norm(prior.translation_m)
    )
