"""A pose beside its rivals: look-alikes of the craft, and the probability of each pose.

A craft that nearly maps onto itself has, for every pose, others whose outline and edges are nearly
the same. With D the reflection across the line of sight, the near-symmetry (S, t) of the mesh takes
a pose (R, c) to (R Sᵀ, c − R Sᵀ t), or to (D R Sᵀ, c − D R Sᵀ t) where S is a reflection: from
afar, a craft and its mirror image across the picture plane have one outline. What the drawn
pictures leave unexplained of the frame, beside the merit of the edges, decides between them.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from rendezview.estimation.hypotheses import posterior
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.drawn import Drawn, DrawnEvidence, Explained, cost_of
from rendezview.sensors.appearance.judge.shading import FRONT, Shading
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky

# Of the log of the cells that stay unexplained, and of the merit. Source: docs/notes/rivals.md
COST_WEIGHT, MERIT_WEIGHT = 22.0, 18.0
# The same where a sketch was drawn, and of the merit on it. Source: docs/notes/rivals.md
COST_BESIDE_SKETCH, MERIT_BESIDE_SKETCH, SKETCH_WEIGHT = 13.0, 12.0, 0.65


class Rivals:
    """Look-alikes of poses of one model, and what the frames of one camera say of them."""

    def __init__(self, model: ViewModel, camera: Camera, shading: Shading | None = None) -> None:
        if model.shape is None:
            raise ValueError("the model has no shape")
        self._turns, self._shifts_m = model.shape.turns, model.shape.shifts_m
        self._mirrored = np.linalg.det(self._turns) < 0.0
        self._centre_m = model.centre_m
        self._evidence = DrawnEvidence(model.shape, model, camera)
        self._shading = shading or Shading(model, camera)

    def with_camera(self, camera: Camera) -> Rivals:
        """The same in the frames of another camera."""
        other = copy(self)
        other._evidence = self._evidence.with_camera(camera)
        other._shading = self._shading.with_camera(camera)
        return other

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
        self, image: Picture, sky: Sky, hypotheses: list[Hypothesis], edges: Array, *,
        beside_sketch: bool = False,
    ) -> list[Hypothesis]:  # fmt: skip
        """Hypotheses of one frame with cost and probability, likeliest first; [] if none is seen.

        Args:
            image: (H, W) frame.
            sky: behind the target. If it knows the Sun, that one counts.
            hypotheses: one at least, with their Suns as the surface points have them.
            edges: (N,) of ``edge_scores``.
            beside_sketch: the lines of a sketch are among the edges.
        """
        known = sky.sun_camera
        suns = [FRONT if one.sun_camera is None else one.sun_camera for one in hypotheses]
        if known is not None:
            suns = [known] * len(hypotheses)
        if len(hypotheses) == 1:
            return [replace(hypotheses[0], sun_camera=suns[0], probability=1.0)]
        cost_weight = COST_BESIDE_SKETCH if beside_sketch else COST_WEIGHT
        window = self._evidence.window(image, sky, hypotheses[0].pose)
        drawn = [self._evidence.drawn(window, one.pose) for one in hypotheses]
        window = window.beside([one for one in drawn if one is not None])
        drawn = [None if one is None else replace(one, window=window) for one in drawn]
        explained = [
            Explained(np.inf, np.inf, sun) if one is None else one.under(sun)
            for one, sun in zip(drawn, suns, strict=True)
        ]
        if known is None:
            explained = _under_best_suns(edges, cost_weight, drawn, explained)
        scores = _scores(edges, cost_weight, explained)
        if not np.isfinite(scores.max()):
            return []
        weighed = [
            replace(one, cost=seen.cost, sun_camera=seen.sun_camera, probability=float(share))
            for one, seen, share in zip(hypotheses, explained, posterior(scores), strict=True)
        ]
        return sorted(weighed, key=lambda one: -one.probability)

    def weigh_coarse(self, image: Picture, sky: Sky, pose: Pose) -> list[Hypothesis]:
        """A pose that no edges have moved, beside its look-alikes; no edges count."""
        hypotheses = []
        for one in (pose, *self.look_alikes(pose)):
            shade = self._shading.of(image, sky, one)
            hypotheses.append(Hypothesis(one, sun_camera=None if shade is None else shade.sun))
        return self.weigh(image, sky, hypotheses, np.zeros(len(hypotheses)))


def _under_best_suns(
    edges: Array, cost_weight: float, drawn: list[Drawn | None], explained: list[Explained]
) -> list[Explained]:
    """Each under the Suns of the two likeliest, too."""
    order = np.argsort(-_scores(edges, cost_weight, explained), kind="stable")
    others = [explained[k].sun_camera for k in order[:2]]
    return [
        seen if one is None else min([seen, *map(one.under, others)], key=cost_of)
        for one, seen in zip(drawn, explained, strict=True)
    ]


def edge_scores(merits: Array, on_sketch: Array | None = None) -> Array:
    """(N,) logarithms of probabilities by edges alone, up to a constant.

    Args:
        merits: (N,) of grey edges.
        on_sketch: (N,) on the sketch, if there is one; NaN: no hold, which counts as the worst of
            the others.
    """
    if on_sketch is None:
        return MERIT_WEIGHT * merits
    held = on_sketch[~np.isnan(on_sketch)]
    worst = float(held.min()) if len(held) else 0.0
    sketch = np.where(np.isnan(on_sketch), worst, on_sketch)
    return np.asarray(MERIT_BESIDE_SKETCH * merits + SKETCH_WEIGHT * sketch)


def _scores(edges: Array, cost_weight: float, explained: list[Explained]) -> Array:
    """(N,) logarithms of probabilities, up to a constant."""
    costs = np.array([one.cost for one in explained])
    return np.asarray(edges - cost_weight * np.log(costs))
