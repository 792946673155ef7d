"""A pose beside its rivals: look-alikes of the craft, and the probability of each pose.

A craft that nearly maps onto itself has, for every pose, others whose outline and edges are nearly
the same. With D the reflection across the line of sight, the near-symmetry (S, t) of the mesh takes
a pose (R, c) to (R Sᵀ, c − R Sᵀ t), or to (D R Sᵀ, c − D R Sᵀ t) where S is a reflection: from
afar, a craft and its mirror image across the picture plane have one outline. What the drawn
pictures leave unexplained of the frame, beside the merit of the edges, decides between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.judge.drawn import DrawnEvidence, Explained, cost_of
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky

COST_WEIGHT = 22.0  # of the log of the cells that stay unexplained
MERIT_WEIGHT = 18.0  # of the merit
# Of the score: a rival so far behind under the Sun of its surface points is not drawn under others.
_IN_DOUBT = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """A pose beside its rivals."""

    pose: Pose
    merit: float
    cost: float  # cells of the frame that it leaves unexplained; inf: too small; NaN: no rival
    sun_camera: Array
    probability: float  # among all that were weighed


class Rivals:
    """Look-alikes of poses of one model, and what the frames of one camera say of them."""

    def __init__(self, model: ViewModel, camera: Camera) -> None:
        if model.shape is None:
            raise ValueError("the model has no shape")
        self._turns, self._shifts_m = model.shape.turns, model.shape.shifts_m
        self._mirrored = np.linalg.det(self._turns) < 0.0
        self._centre_m = model.centre_m
        self._evidence = DrawnEvidence(model.shape, model, camera)

    def look_alikes(self, pose: Pose) -> list[Pose]:
        """Poses (camera_from_target) that look nearly like one."""
        centre = pose.apply(self._centre_m)
        sight = centre / np.linalg.norm(centre)
        across = np.eye(3) - 2.0 * np.outer(sight, sight)
        found = []
        for turn, shift_m, mirrored in zip(
            self._turns, self._shifts_m, self._mirrored, strict=True
        ):
            seen = across @ pose.rotation if mirrored else pose.rotation
            rotation = seen @ turn.T
            moved = centre - rotation @ shift_m
            found.append(Pose(rotation, moved - rotation @ self._centre_m))
        return found

    def weigh(
        self, image: Picture, sky: Sky, poses: list[Pose], merits: list[float], suns: list[Array]
    ) -> list[Weighed]:
        """Poses of one frame with their probabilities, the likeliest first.

        Args:
            image: (H, W) frame.
            sky: behind the target.
            poses: camera_from_target, one at least.
            merits: of their edges.
            suns: (3,) towards the Sun of each, camera frame, as the surface points have it.
        """
        if len(poses) == 1:
            return [Weighed(poses[0], merits[0], math.nan, suns[0], 1.0)]
        window = self._evidence.window(image, sky, poses[0])
        drawn = [self._evidence.drawn(window, pose) for pose in poses]
        window = window.beside([one for one in drawn if one is not None])
        drawn = [None if one is None else replace(one, window=window) for one in drawn]
        explained = [
            Explained(math.inf, sun) if one is None else one.under(sun)
            for one, sun in zip(drawn, suns, strict=True)
        ]
        order = np.argsort(-_scores(merits, explained), kind="stable")
        others = [explained[k].sun_camera for k in order[:2]]
        explained = [
            seen if one is None else min([seen, *map(one.under, others)], key=cost_of)
            for one, seen in zip(drawn, explained, strict=True)
        ]
        scores = _scores(merits, explained)
        for k, one in enumerate(drawn):
            if one is not None and scores[k] >= scores.max() - _IN_DOUBT:
                explained[k] = one.under_best(explained[k])
        scores = _scores(merits, explained)
        odds = np.exp(scores - max(float(scores.max()), -1e300))
        shares = odds / max(float(odds.sum()), 1e-300)
        weighed = [
            Weighed(pose, edges, seen.cost, seen.sun_camera, float(share))
            for pose, edges, seen, share in zip(poses, merits, explained, shares, strict=True)
        ]
        return sorted(weighed, key=lambda w: -w.probability)


def _scores(merits: list[float], explained: list[Explained]) -> Array:
    """(N,) logarithms of probabilities, up to a constant."""
    costs = np.array([one.cost for one in explained])
    return np.asarray(MERIT_WEIGHT * np.array(merits) - COST_WEIGHT * np.log(costs))
