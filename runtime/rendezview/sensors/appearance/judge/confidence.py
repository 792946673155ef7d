"""Choice of the best of a frame's poses, and the probability that it is right."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between, first_of_each
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.refinement import Refined, Refiner
from rendezview.sensors.appearance.judge.rivals import (
    MERIT_WEIGHT,
    Rivals,
    Weighed,
    edge_scores,
)
from rendezview.sensors.appearance.judge.shading import Shade, Shading
from rendezview.sensors.appearance.judge.sketch_choice import Aligned, SketchPose
from rendezview.sensors.appearance.model.error_model import ErrorModel
from rendezview.sensors.appearance.model.forest import ForestScores
from rendezview.sensors.appearance.model.signature import Outlines
from rendezview.sensors.appearance.outline.retrieval import Retrieval
from rendezview.sensors.appearance.sky import Sky

Bound = Callable[[Pose], bool]  # whether a pose may be the answer at all
Indices = npt.NDArray[np.intp]

# Weights of the merit, beside an inlier ratio of weight 1.
# Of mean radii of the silhouette. Source: by hand, seeds of docs/notes/refinement.md
_OVERSHOOT_WEIGHT = 1.0
# Of the share of grey levels that one light explains. Source: by hand, seeds of
# docs/notes/refinement.md
_LIGHT_WEIGHT = 0.25
# Source: experiment pose-accuracy, seeds 1, 88, 99 (commits f070326, 5e90c44)
_RESIDUAL_WEIGHT = 0.08  # of log px
# px; a smaller residual is no better. Source: by hand, seeds of docs/notes/refinement.md
_LEAST_RESIDUAL_PX = 0.05
# Source: experiment pose-accuracy, seeds 1, 88, 99: of 1626 frames with a right and a wrong pose
# the wrong one came first in 13 with shading, in 34 without
_SHADING_WEIGHT = 0.4  # of a correlation
# merit behind the best; shading is computed for poses closer than this. Source: by hand, seeds of
# docs/notes/refinement.md
_IN_DOUBT = 0.35

# rad; a pose further away is another answer, as in the experiments. Source: the limit of a wrong
# pose there
_RIVAL_RAD = np.deg2rad(5.0)
# Of overshoot and of margin in the regression, which saturate there. Source: fixed with the fit of
# error_model.json
_MOST_FEATURE = 0.3
_MOST_RIVALS = 16  # that are drawn, of most merit. Source: by construction, a bound of time
_FRONT = np.array([0.0, 0.0, -1.0])  # Sun behind the camera. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best pose of a frame and its rival, the best pose more than 5° away."""

    best: Refined
    overshoot: (
        float  # of bright outlines beyond the predicted silhouette, see ``Retrieval.overshoot``
    )
    margin: float  # merit of the best pose above its rival's; 1 without a rival
    dark: bool  # the sky is dark
    prior: bool  # found near a prior
    rival: Refined | None = None
    shading: float | None = None  # see ``Refiner.shading``; None: not computed
    votes: float | None = None  # log odds of the outline's forest about it; None: not asked
    single: bool = False  # only the pose next to the prior was tried
    weighed: tuple[Weighed, ...] = ()  # beside its look-alikes, the likeliest first; (): not asked
    error_model: ErrorModel = field(default_factory=ErrorModel.packaged)

    @property
    def merit(self) -> float:
        """Merit of the best pose; see ``merit``."""
        return merit(self.best, self.overshoot, self.shading)

    @property
    def posterior(self) -> float:
        """Probability of the pose among its look-alikes; 1 where they were not asked."""
        return self.weighed[0].probability if self.weighed else 1.0

    @property
    def answers(self) -> list[Pose]:
        """The best pose, and its rival if there is one."""
        return [found.pose for found in (self.best, self.rival) if found is not None]

    @property
    def features(self) -> Array:
        """(11,) in the order of ``CONFIDENCE_FEATURES``."""
        best = self.best
        return np.array(
            [
                1.0,
                best.outline,
                best.inner,
                best.residual_px,
                min(self.overshoot, _MOST_FEATURE),
                min(max(self.margin, 0.0), _MOST_FEATURE),
                best.visible,
                float(self.dark),
                float(self.prior),
                best.light,
                self.shading or 0.0,
            ]
        )

    @property
    def confidence(self) -> float:
        """Probability that the best pose is right to 5°, 0 … 1."""
        return self.error_model.confidence(
            self.features, shading=self.shading is not None, dark=self.dark
        )


def merit(refined: Refined, overshoot: float, shading: float | None) -> float:
    """One figure to compare poses of one frame by."""
    edges = refined.inlier_ratio - _OVERSHOOT_WEIGHT * overshoot + _LIGHT_WEIGHT * refined.light
    edges -= _RESIDUAL_WEIGHT * math.log(max(refined.residual_px, _LEAST_RESIDUAL_PX))
    return edges if shading is None else edges + _SHADING_WEIGHT * shading


@dataclass(slots=True, eq=False)
class _Candidate:
    """A refined pose, with what else was computed for it."""

    refined: Refined
    overshoot: float
    shade: Shade | None = None  # None: not computed yet, or the model has no surface

    @property
    def shading(self) -> float | None:
        """Agreement of the surface points with the frame."""
        return None if self.shade is None else self.shade.agreement


def _sun_of(candidate: _Candidate) -> Array:
    """(3,) where the surface points have the Sun; behind the camera where they do not tell."""
    shade = candidate.shade
    return _FRONT if shade is None or not shade.sun_camera.any() else shade.sun_camera


@dataclass(slots=True, eq=False)
class Candidates:
    """All refined poses of one frame; each costs its overshoot and its shading once."""

    refiner: Refiner
    shading: Shading
    retrieval: Retrieval
    image: Picture
    sky: Sky
    bodies: list[Outlines]
    forest_scores: ForestScores | None = None
    prior: bool = False  # the search starts from a prior
    bounds: tuple[Bound, ...] = ()  # of all poses
    _all: list[_Candidate] = field(default_factory=list)

    def add(self, refined: list[Refined]) -> None:
        """Take more poses, those within the bounds."""
        may_be = (r for r in refined if all(bound(r.pose) for bound in self.bounds))
        self._all += [_Candidate(r, self._overshoot(r)) for r in may_be]

    @property
    def most_inliers(self) -> Refined | None:
        """The pose with the highest inlier ratio, the first of equals."""
        best = max(self._all, key=lambda c: c.refined.inlier_ratio, default=None)
        return None if best is None else best.refined

    def choose(self, *, shade: bool = True) -> Found | None:
        """The pose of most merit and its rival; None without any pose.

        ``shade``: compute the shading of those poses whose edges leave them a chance.
        """
        if not self._all:
            return None
        by_edges = [merit(c.refined, c.overshoot, None) for c in self._all]
        least = max(by_edges) - _IN_DOUBT if shade else np.inf
        merits = []
        for c, edges in zip(self._all, by_edges, strict=True):
            if edges >= least and c.shade is None:
                c.shade = self.shading.of(self.image, self.sky, c.refined.pose)
            merits.append(merit(c.refined, c.overshoot, c.shading if edges >= least else None))
        k = int(np.argmax(merits))
        best = self._all[k]
        j = self._rival(best, merits)
        return Found(
            best.refined,
            best.overshoot,
            1.0 if j is None else merits[k] - merits[j],
            self.sky.dark,
            self.prior,
            None if j is None else self._all[j].refined,
            best.shading,
            self._votes(best.refined),
            error_model=self.refiner.error_model,
        )

    def weighed(self, rivals: Rivals, on_sketch: Aligned | None = None) -> Found | None:
        """The likeliest pose beside its rivals, by drawn evidence; None without any pose.

        ``on_sketch``: of the sketch, where one was drawn of the frame. Poses that it leads to the
        same pose are one answer.
        """
        found = self.choose()
        if found is None:
            return None
        merits = [merit(c.refined, c.overshoot, c.shading) for c in self._all]
        apart = self._apart(merits, found.merit - _IN_DOUBT if on_sketch is None else -np.inf)
        asked = [self._all[k] for k in apart]
        sketch = None if on_sketch is None else on_sketch([c.refined.pose for c in asked])
        edges = edge_scores(
            np.array([merits[k] for k in apart]),
            None
            if sketch is None
            else np.array([np.nan if s is None else s.merit for s in sketch]),
        )
        order = np.argsort(-edges, kind="stable")
        order = order[edges[order] >= edges.max() - MERIT_WEIGHT * _IN_DOUBT]
        if sketch is not None:
            order = self._one_each(order, sketch)
        order = order[:_MOST_RIVALS]
        weighed = rivals.weigh(
            self.image, self.sky, [asked[k].refined.pose for k in order], edges[order],
            [_sun_of(asked[k]) for k in order],
            None if sketch is None else [sketch[k] for k in order],
        )  # fmt: skip
        if not weighed:
            return found
        k = next(k for k, c in enumerate(self._all) if c.refined.pose is weighed[0].pose)
        best = self._all[k]
        j = self._rival(best, merits)
        return replace(
            found,
            best=best.refined,
            overshoot=best.overshoot,
            margin=1.0 if j is None else merits[k] - merits[j],
            rival=None if j is None else self._all[j].refined,
            shading=best.shading,
            votes=self._votes(best.refined),
            weighed=tuple(weighed),
        )

    def _one_each(self, order: Indices, sketch: list[SketchPose | None]) -> Indices:
        """Of the poses that a sketch leads to the same pose the first."""
        led = [(int(k), one.pose) for k in order if (one := sketch[k]) is not None]
        symmetries = self.refiner.model.symmetries
        firsts = first_of_each((pose for _, pose in led), _RIVAL_RAD, symmetries)
        kept = {led[i][0] for i in firsts}
        return np.array([k for k in order if sketch[k] is None or int(k) in kept])

    def _apart(self, merits: list[float], least: float) -> list[int]:
        """Of the poses of one answer the one of most merit, in the order of merit."""
        order = [int(k) for k in np.argsort(-np.array(merits), kind="stable") if merits[k] >= least]
        poses = (self._all[k].refined.pose for k in order)
        return [order[i] for i in first_of_each(poses, _RIVAL_RAD, self.refiner.model.symmetries)]

    def _rival(self, best: _Candidate, merits: list[float]) -> int | None:
        """The pose of most merit that is another answer than the best."""
        symmetries, pose = self.refiner.model.symmetries, best.refined.pose
        others = [
            j
            for j, c in enumerate(self._all)
            if angle_between(c.refined.pose, pose, symmetries) > _RIVAL_RAD
        ]
        return max(others, key=lambda j: merits[j], default=None)

    def _votes(self, refined: Refined) -> float | None:
        """Log odds of the forest, of the outline that gives most; None before a bright sky."""
        if self.forest_scores is None or not self.sky.dark:
            return None
        rotation = refined.pose.rotation[None]
        scores = [float(self.forest_scores.scores(b.signature, rotation)[0]) for b in self.bodies]
        return max(scores, default=None)

    def _overshoot(self, refined: Refined) -> float:
        """The largest of any outline; 0 before a bright sky, where outlines are uncertain."""
        if not self.sky.dark:
            return 0.0
        pose = refined.pose
        return max((self.retrieval.overshoot(b.rays, pose) for b in self.bodies), default=0.0)
