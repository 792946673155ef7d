"""All poses of one frame: the choice of the best beside its rivals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from rendezview.estimation.hypotheses import Choice, best_by, choose
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.hypothesis import Aligned, Bound, Hypothesis
from rendezview.sensors.appearance.judge.found import Found, agree, merit, one_answer
from rendezview.sensors.appearance.judge.level import Level
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.judge.rivals import MERIT_WEIGHT, RIVAL_RAD, line_scores
from rendezview.sensors.appearance.judge.sketch_choice import sketch_merit
from rendezview.sensors.appearance.model.forest import ForestScores
from rendezview.sensors.appearance.model.signature import Outlines
from rendezview.sensors.appearance.outline.retrieval import Retrieval
from rendezview.sensors.appearance.sky import Sky

# merit behind the best; shading is computed for poses closer than this. Source: by hand, seeds of
# docs/notes/refinement.md
_IN_DOUBT = 0.35
# Log odds by edges behind the best; poses closer than this are drawn. Source: docs/notes/rivals.md
_MOST_BEHIND = 8.0
# rad; error of a good proposal. Source: by hand, seeds of docs/notes/refinement.md
CLOSE_RAD = np.deg2rad(3.0)
_MOST_RIVALS = 32  # that are drawn, of most merit. Source: by construction, a bound of time


@dataclass(slots=True, eq=False)
class Candidates:
    """All refined poses of one frame; each costs its overshoot and its shading once."""

    level: Level
    retrieval: Retrieval
    image: Picture
    sky: Sky
    outlines: Outlines | None
    forest_scores: ForestScores | None = None
    near: Near | None = None  # where the answer is
    bounds: tuple[Bound, ...] = ()  # of all poses
    _all: list[Hypothesis] = field(default_factory=list)

    def may_be(self, pose: Pose) -> bool:
        """Whether a pose is within the bounds."""
        return (self.near is None or self.near.holds(pose)) and all(b(pose) for b in self.bounds)

    @property
    def reach_rad(self) -> float:
        """How far two poses may be from each other."""
        return math.pi if self.near is None else min(2.0 * self.near.furthest_rad, math.pi)

    def add(self, refined: Iterable[Hypothesis | None]) -> None:
        """Take more poses, those within the bounds."""
        for one in refined:
            if one is not None and self.may_be(one.pose):
                self._all.append(replace(one, overshoot=self._overshoot(one)))

    def refine(self, poses: Iterable[Pose], *, least: float = 0.0) -> None:
        """Add the poses next to some that fit the edges; see ``Refiner.refine``."""
        image, sky, refine = self.image, self.sky, self.level.refiner.refine
        self.add(refine(image, sky, one, least=least) for one in poses)

    def add_next_to(self, start: Pose, refined: Hypothesis | None) -> None:
        """Add a start that may be right to a few degrees, as ``refine`` has aligned it.

        Where the coarse stages led elsewhere, what is next to the start counts, too.
        """
        self.add([refined])
        if refined is None or refined.pose.angle_to(start) > CLOSE_RAD:
            self.refine_closely([start])

    def refine_next_to(self, poses: Iterable[Pose]) -> None:
        """Align starts that may be right to a few degrees."""
        for start in poses:
            self.add_next_to(start, self.level.refiner.refine(self.image, self.sky, start))

    def refine_closely(self, poses: Iterable[Pose], *, least: float = 0.0) -> None:
        """Add the poses next to some that fit the edges, without the coarse stages."""
        image, sky, refine = self.image, self.sky, self.level.refiner.refine
        self.add(refine(image, sky, one, closely=True, least=least) for one in poses)

    def refine_best(
        self, rotations: Array, centres: Array, keep: int, *, least: float = 0.0
    ) -> None:
        """Add the best of some starting poses, aligned; see ``Refiner.best``."""
        image, sky, best = self.image, self.sky, self.level.refiner.best
        self.add(best(image, sky, rotations, centres, keep, least=least))

    @property
    def most_inliers(self) -> Hypothesis | None:
        """The pose with the highest inlier ratio, the first of equals."""
        return best_by(lambda one: one.inlier_ratio, self._all)

    def choose(self, *, shade: bool = True) -> Found | None:
        """The pose of most merit and its rival; None without any pose.

        ``shade``: compute the shading of those poses whose edges leave them a chance.
        """
        if not self._all:
            return None
        merits = [merit(one, None) for one in self._all]
        least = max(merits) - _IN_DOUBT if shade else np.inf
        for k, one in enumerate(self._all):
            if merits[k] >= least:
                self._all[k] = self._shaded(one)
                merits[k] = merit(one, self._all[k].shading)
        chosen = choose(merits, self._same)
        assert chosen is not None
        return self._found(chosen)

    def _shaded(self, one: Hypothesis) -> Hypothesis:
        if one.shading is not None:
            return one
        shade = self.level.shading.of(self.image, self.sky, one.pose)
        return one if shade is None else replace(one, shading=shade.agreement, sun_camera=shade.sun)

    def weighed(self, on_sketch: Aligned | None = None) -> Found | None:
        """The likeliest pose beside its rivals, by drawn evidence if the model has a shape.

        ``on_sketch``: of the sketch, where one was drawn of the frame.
        """
        found, rivals = self.choose(), self.level.rivals
        if found is None or rivals is None:
            return found
        merits = np.array([merit(one, one.shading) for one in self._all])
        within = np.inf if on_sketch is not None else merits.max() - (found.merit - _IN_DOUBT)
        apart = choose(merits, self._one_optimum, within=within, most=len(merits))
        assert apart is not None
        asked, lines = [self._all[k] for k in apart.answers], None
        own = merits[list(apart.answers)]
        if on_sketch is not None:
            led = on_sketch([one.pose for one in asked])
            asked = [replace(one, on_sketch=there) for one, there in zip(asked, led, strict=True)]
            lines = line_scores(
                np.array([np.nan if one is None else sketch_merit(one) for one in led])
            )
        edges = MERIT_WEIGHT * own + (0.0 if lines is None else lines)
        order = np.argsort(-edges, kind="stable")
        order = order[edges[order] >= edges.max() - _MOST_BEHIND][:_MOST_RIVALS]
        weighed = rivals.weigh(
            self.image, self.sky, [asked[k] for k in order], own[order],
            None if lines is None else lines[order],
        )  # fmt: skip
        if not weighed:
            return found
        k = next(k for k, one in enumerate(self._all) if one.pose is weighed[0].pose)
        weighed = one_answer(weighed, self.level.refiner.model.symmetries)
        chosen = choose(merits, self._same, best=k)
        assert chosen is not None
        best = replace(self._all[k], covariance=weighed[0].covariance)
        found = replace(self._found(chosen), best=best, weighed=tuple(weighed))
        if len(weighed) == 1:
            return found
        # Its look-alikes have the same edges, and pictures tell it from them: edges need only lead
        # the others, which may show that it is a local optimum.
        family = [self._all[k].pose, *rivals.look_alikes(self._all[k].pose)]

        def alike(n: int, _best: int) -> bool:
            return any(self._all[n].pose.angle_to(one) <= RIVAL_RAD for one in family)

        beside = choose(merits, alike, best=k)
        assert beside is not None
        return replace(found, margin=beside.margin if beside.rivals else 1.0)

    def _found(self, chosen: Choice) -> Found:
        best = self._all[chosen.best]
        return Found(
            best,
            chosen.margin if chosen.rivals else 1.0,
            self.sky.dark,
            self.near is not None,
            self._all[chosen.rivals[0]] if chosen.rivals else None,
            self._votes(best),
        )

    def _same(self, k: int, known: int) -> bool:
        """Whether two poses are one answer."""
        a, b = self._all[k].pose, self._all[known].pose
        return bool(angle_between(a, b, self.level.refiner.model.symmetries) <= RIVAL_RAD)

    def _one_optimum(self, k: int, known: int) -> bool:
        """Whether two poses are one answer, and their covariances allow for what they differ by."""
        a, b = self._all[k], self._all[known]
        return self._same(k, known) and agree(a, b, self.level.refiner.model.symmetries)

    def _votes(self, one: Hypothesis) -> float | None:
        """Log odds of the forest; None before a bright sky."""
        if self.forest_scores is None or self.outlines is None or not self.sky.dark:
            return None
        rotation = one.pose.rotation[None]
        return float(self.forest_scores.scores(self.outlines.signature, rotation)[0])

    def _overshoot(self, one: Hypothesis) -> float:
        """0 before a bright sky, where outlines are uncertain."""
        if not self.sky.dark or self.outlines is None:
            return 0.0
        return self.retrieval.overshoot(self.outlines.rays, one.pose)
