"""A pose beside its rivals: look-alikes of the craft, and the probability of each pose.

A craft that nearly maps onto itself has, for every pose, others whose outline and edges are nearly
the same. With D the reflection across the line of sight, the near-symmetry (S, t) of the mesh takes
a pose (R, c) to (R Sᵀ, c − R Sᵀ t), or to (D R Sᵀ, c − D R Sᵀ t) where S is a reflection: from
afar, a craft and its mirror image across the picture plane have one outline. What the drawn
pictures leave unexplained of the frame, beside the merit of the edges, decides between them.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

import numpy as np

from rendezview.estimation.hypotheses import posterior
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.drawn import (
    Drawn,
    DrawnEvidence,
    Explained,
    Window,
    cost_of,
)
from rendezview.sensors.appearance.judge.shading import FRONT, Shading
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky

# Of the difference of two pictures over its spread, of the merit of edges, and of that on a sketch
# where one was drawn. Source: docs/notes/rivals.md
DRAWN_WEIGHT, MERIT_WEIGHT, SKETCH_WEIGHT = 1.75, 10.0, 0.5
# Of the craft's cells, that stay unexplained where its materials are known. Where more do, errors
# of neighbouring cells are alike, and their differences count less. Source: docs/notes/rivals.md
_KNOWN_SHARE = 0.1
# Cells squared, of the spread: less says nothing. Source: docs/notes/rivals.md
_LEAST_SPREAD = 0.1
# Of the compared pixels: two poses whose pictures differ in fewer have nearly the same edges, and
# their merits differ by chance; the same of the lines of a sketch. Source: docs/notes/rivals.md
_OTHER_EDGES, _OTHER_LINES = 0.1, 0.03
# rad; a pose, or the angle of a joint, further away is another answer, as in the experiments.
# Source: the limit of a wrong pose there
RIVAL_RAD = np.deg2rad(5.0)
_IN_DOUBT = 0.9999  # probability; below it Suns are looked for on the picture. Source: the same
_ROUNDING = 1e-9  # of a trace. Source: by construction
_ROUNDS = 2  # of comparisons with the likeliest. Source: by construction


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

    def look_alikes(self, pose: Pose, most_rad: float = np.pi) -> list[Pose]:
        """Poses (camera_from_target) that look nearly like one, turned by ``most_rad`` at most."""
        centre = pose.apply(self._centre_m)
        sight = centre / np.linalg.norm(centre)
        mirrored = pose.rotation - 2.0 * np.outer(sight, sight @ pose.rotation)
        seen = np.where(self._mirrored[:, None, None], mirrored, pose.rotation)
        rotations = seen @ self._turns.transpose(0, 2, 1)
        traces = np.einsum("kij,ij->k", rotations, pose.rotation)
        near = traces >= 1.0 + 2.0 * np.cos(most_rad) - _ROUNDING
        rotations, shifts_m = rotations[near], self._shifts_m[near] + self._centre_m
        return list(map(Pose, rotations, centre - np.einsum("kij,kj->ki", rotations, shifts_m)))

    def weigh(
        self, image: Picture, sky: Sky, hypotheses: list[Hypothesis], merits: Array,
        lines: Array | None = None,
    ) -> list[Hypothesis]:  # fmt: skip
        """Hypotheses of one frame with cost and probability, likeliest first; [] if none is seen.

        Args:
            image: (H, W) frame.
            sky: behind the target. If it knows the Sun, that one counts.
            hypotheses: one at least, with their Suns as the surface points have them.
            merits: (N,) of their grey edges.
            lines: (N,) of ``line_scores``, if there is a sketch.
        """
        known = sky.sun_camera
        suns = [FRONT if one.sun_camera is None else one.sun_camera for one in hypotheses]
        if known is not None:
            suns = [known] * len(hypotheses)
        if len(hypotheses) == 1:
            return [replace(hypotheses[0], sun_camera=suns[0], probability=1.0)]
        window = self._evidence.window(image, sky, hypotheses[0].pose)
        drawn = [self._evidence.drawn(window, one.pose) for one in hypotheses]
        kept = [k for k, one in enumerate(drawn) if one is not None]
        window = window.beside([one for one in drawn if one is not None])
        each = [replace(one, window=window) for one in drawn if one is not None]
        if not each:
            return []
        explained = [one.under(suns[k]) for one, k in zip(each, kept, strict=True)]
        merits = merits[kept]
        beside = np.zeros(len(kept)) if lines is None else lines[kept]

        def scored(explained: list[Explained]) -> tuple[Array, Array]:
            return _scores(merits, beside, explained, window, _drawn_weight(each, explained))

        scores, distinct = scored(explained)
        if known is None:
            explained = _under_best_suns(scores, each, explained, look=False)
            scores, distinct = scored(explained)
            if _best_answer(scores, each) < _IN_DOUBT:
                explained = _under_best_suns(scores, each, explained, look=True)
                scores, distinct = scored(explained)
        for _ in range(_ROUNDS):
            best = int(np.argmax(scores))
            explained = self._turned_in_place(each, explained, best)
            scores, distinct = scored(explained)
            if int(np.argmax(scores)) == best:
                break
        weighed = [
            replace(one, cost=np.inf, sun_camera=sun, probability=0.0)
            for one, sun in zip(hypotheses, suns, strict=True)
        ]
        shares = posterior(scores)
        for k, seen, share, apart in zip(kept, explained, shares, distinct, strict=True):
            weighed[k] = replace(
                weighed[k], cost=seen.cost, sun_camera=seen.sun_camera, probability=float(share),
                distinct=float(apart),
            )  # fmt: skip
        return sorted(weighed, key=lambda one: -one.probability)

    def _turned_in_place(
        self, drawn: list[Drawn], explained: list[Explained], best: int
    ) -> list[Explained]:
        """Look-alikes of the likeliest pose drawn in its place, too, if they explain more there.

        Edges that mislead may have moved only one of them.
        """
        explained = list(explained)
        for there in self.look_alikes(drawn[best].pose):
            apart = [one.pose.angle_to(there) for one in drawn]
            k = int(np.argmin(apart))
            turned = None
            if k != best and apart[k] <= RIVAL_RAD:
                turned = self._evidence.drawn(drawn[best].window, there)
            if turned is not None:
                suns = [explained[best].sun_camera, explained[k].sun_camera]
                explained[k] = min([explained[k], *map(turned.under, _unlike(suns))], key=cost_of)
        return explained

    def weigh_coarse(self, image: Picture, sky: Sky, pose: Pose) -> list[Hypothesis]:
        """A pose that no edges have moved, beside its look-alikes; no edges count."""
        hypotheses = []
        for one in (pose, *self.look_alikes(pose)):
            shade = self._shading.of(image, sky, one)
            hypotheses.append(Hypothesis(one, sun_camera=None if shade is None else shade.sun))
        return self.weigh(image, sky, hypotheses, np.zeros(len(hypotheses)))


def _best_answer(scores: Array, drawn: list[Drawn]) -> float:
    """Probability of the likeliest pose and of those that are the same answer."""
    shares = posterior(scores)
    best = drawn[int(np.argmax(shares))].pose
    same = [one.pose.angle_to(best) <= RIVAL_RAD for one in drawn]
    return float(shares[same].sum())


def _drawn_weight(drawn: list[Drawn], explained: list[Explained]) -> float:
    """Of the pictures: less where none explains the craft as one of known materials would."""
    shares = [
        seen.cost * one.window.cell_px / len(one.where)
        for one, seen in zip(drawn, explained, strict=True)
    ]
    return DRAWN_WEIGHT * min(1.0, _KNOWN_SHARE / max(min(shares), 1e-9))


def _under_best_suns(
    scores: Array, drawn: list[Drawn], explained: list[Explained], *, look: bool
) -> list[Explained]:
    """Each under the Suns of the two likeliest, too; ``look``: as their pictures show them best."""
    order = np.argsort(-scores, kind="stable")[:2]
    if look:
        explained, first = list(explained), order[0]
        explained[first] = drawn[first].under_best_sun(explained[first])
        for k in order[1:]:  # the Sun is most likely there, too
            there = drawn[k].under(explained[first].sun_camera)
            explained[k] = drawn[k].under_best_sun(min(explained[k], there, key=cost_of), near=True)
    others = [explained[k].sun_camera for k in order]
    return [
        min([seen, *map(one.under, _unlike(others, seen.sun_camera))], key=cost_of)
        for one, seen in zip(drawn, explained, strict=True)
    ]


def _unlike(suns: list[Array], known: Array | None = None) -> list[Array]:
    """Each Sun once, without the one that is known."""
    each = {sun.tobytes(): sun for sun in suns}
    if known is not None:
        each.pop(known.tobytes(), None)
    return list(each.values())


def line_scores(on_sketch: Array) -> Array:
    """(N,) logarithms of probabilities by a sketch alone, up to a constant.

    Args:
        on_sketch: (N,) merits; NaN: no hold, which counts as the worst of the others.
    """
    held = on_sketch[~np.isnan(on_sketch)]
    worst = float(held.min()) if len(held) else 0.0
    return np.asarray(SKETCH_WEIGHT * np.where(np.isnan(on_sketch), worst, on_sketch))


def _scores(
    merits: Array, lines: Array, explained: list[Explained], window: Window, weight: float
) -> tuple[Array, Array]:
    """(N,) logarithms of probabilities, up to a constant: log odds against the likeliest.

    Two poses are compared cell by cell: what both leave unexplained cancels. The sum of the
    differences counts in units of its spread (Vuong 1989). Edges and lines of a sketch count as
    far as the pictures differ: those of poses that look the same differ by chance.

    Returns:
        Beside them (N,) how far a picture differs from the likeliest's, 0 … 1: by enough pixels.
    """
    best = int(np.argmin([one.cost for one in explained]))
    scores, distinct = np.zeros((2, len(explained)))
    for _ in range(_ROUNDS):
        other = explained[best]
        for k, one in enumerate(explained):
            better = other.cells - one.cells
            spread = math.sqrt(float((better**2).sum()) + _LEAST_SPREAD)
            apart = np.abs(one.picture - other.picture) > window.tolerance_grey
            other_pixels = float(apart.sum()) / len(window.seen)
            distinct[k] = min(1.0, other_pixels / _OTHER_LINES)
            scores[k] = weight * better.sum() / spread + distinct[k] * (lines[k] - lines[best])
            edges = min(1.0, other_pixels / _OTHER_EDGES)
            scores[k] += MERIT_WEIGHT * edges * (merits[k] - merits[best])
        likeliest = int(np.argmax(scores))
        if likeliest == best:
            break
        best = likeliest
    return scores, distinct
