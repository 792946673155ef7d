"""The search for the pose of a frame on its edges.

Retrieval proposes views and rolls by the signature of the outline. Alignment moves many of them
roughly onto the edges (``alignment``), refinement the best ones exactly, with edge profiles under
the fitted light (``refinement``). Shading decides between poses whose edges are alike, and a
regression gives the confidence of the best (``Found.confidence``).
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.refinement import RefineOptions, Refiner
from rendezview.sensors.appearance.hypothesis import Bound, Hypothesis
from rendezview.sensors.appearance.judge.candidates import CLOSE_RAD, Candidates
from rendezview.sensors.appearance.judge.found import Found, share_of
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.model.signature import Outlines
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.outline.retrieval import Retrieval
from rendezview.sensors.appearance.outline.voted import likely
from rendezview.sensors.appearance.search.levels import Levels
from rendezview.sensors.appearance.search.starts import (
    half_turns,
    rotated_about,
    rotated_by,
)
from rendezview.sensors.appearance.sky import Sky

# Source: commit 7a5ba6e, experiment pose-accuracy
_CONFIDENT = 0.98  # probability; such a pose next to a prior needs no shading
# The same that ends a search. Source: confidence-fit: in 541 of 1,268 searches a right choice
# reaches it, in none a wrong one
_ENDS = 0.995
_CONFIRMED = 0.9  # the same after a search. Source: as of a restart, TrackerOptions
_REFINED_OF_VOTED = 2  # Source: experiment tree-ablation (0.1), seed 4101
# With a forest: the likeliest are aligned first, and two of them refined. Where edges and the
# forest agree on a pose, nothing else is tried. Source: tree-ablation (0.1), seed 4101
_VOTED_FIRST = 8
# Log odds of the nodes about a pose: a forest that knows nothing gives −2.2, the share of a node's
# views among its samples. Source: experiment tree-ablation (0.1), seed 4101
_LEAST_VOTES = -2.0
# Inlier ratio after coarse alignment, before a sketch: of 252 right poses of Mitsuba none had less.
# Source: docs/notes/photographs.md
_WORTH_REFINING = 0.15
# Inlier ratio of a look-alike after the first stages, behind the best pose's: of 300 that come
# within 0.15 of its merit, 1 % are farther behind. Source: docs/notes/rivals.md
_MOST_BEHIND = 0.3
# Poses that pictures speak for, or that are better than the one whose surroundings led to them.
_MOST_ASKED = 4  # Source: by construction, a bound of time
# rad; a local optimum lies about that far from the right pose. Source: spacing of the nodes' views,
# 8.6°
_ASIDE_RAD = np.deg2rad(9.0)
# Of its range: edges that are taken for others hold a pose up to a sixth too near or too far.
# Source: docs/notes/refinement.md, local optima
_ASIDE_RANGES = np.array([1.0, 0.87, 1.15])
_KEPT_ASIDE = 3  # of the poses around it that are refined. Source: the same

# Views and rolls that are aligned without a prior. Source: by hand, seeds of
# docs/notes/refinement.md
_RETRIEVED = 60
_RETRIEVED_FIRST = 20  # the same where a sketch comes next. Source: commit cb7137c
_REFINED = 6  # of them that are refined. Source: by hand, seeds of docs/notes/refinement.md
_REFINED_NEAR = 3  # the same near a prior. Source: by hand, seeds of docs/notes/refinement.md
# Source: commit f31a7df; poses 5° to 10° off the truth reached the limit before it
_ENOUGH = 0.5  # inlier ratio of the pose next to a prior: then nothing else is tried …
# … and before a bright sky, where clouds give edges too. Source: by hand, seeds of
# docs/notes/refinement.md
_ENOUGH_BRIGHT = 0.6


class PoseSearch:
    """Finds poses of one model in the frames of one camera, where it has a suitable size."""

    def __init__(self, model: ViewModel, camera: Camera) -> None:
        self.model = model
        self.levels = Levels(model, camera)
        self.bounds: tuple[Bound, ...] = ()  # of all poses
        self._retrieval = Retrieval(model)
        self._forest_scores = model.forest_scores()  # None: the model has no forest
        self._half_turns = half_turns(model)

    def with_camera(
        self, camera: Camera, *bounds: Bound, options: RefineOptions | None = None
    ) -> PoseSearch:
        """The same search in the frames of another camera, and within more bounds.

        ``options`` of refinement: None for the own.
        """
        other = copy(self)
        other.levels = self.levels.with_camera(camera, options)
        other.bounds = (*self.bounds, *bounds)
        return other

    @property
    def refiner(self) -> Refiner:
        """That of the picture itself."""
        return self.levels.whole.refiner

    def _candidates(
        self, image: Picture, sky: Sky, size: Pose | float, outlines: Outlines | None,
        near: Near | None = None,
    ) -> Candidates:  # fmt: skip
        """No poses yet, at the level of a pose or a range."""
        range_m = self.levels.range_m(size) if isinstance(size, Pose) else size
        level, image, sky = self.levels.at(image, sky, range_m)
        scores = self._forest_scores if near is None else None
        return Candidates(level, self._retrieval, image, sky, outlines, scores, near, self.bounds)

    def anywhere(
        self, image: Picture, sky: Sky, outlines: Outlines, *, brief: bool = False,
        give_up: float = 0.0,
    ) -> Found | None:  # fmt: skip
        """The pose without a prior, from a reading of the outline.

        Args:
            brief: of the likeliest starts only, confident or not.
            give_up: a sketch comes next, so the likeliest starts are tried alone; confidence that
                they must reach, else their look-alikes are not.
        """
        signature = outlines.signature
        range_m = math.sqrt(float(np.median(self.model.views.area_m2)) / signature.area_sr)
        candidates = self._candidates(image, sky, range_m, outlines)
        times = self.levels.whole.camera.width // candidates.level.camera.width
        if times > 1:  # the outlines are finer than the picture
            outlines = Outlines([r[::times].copy() for r in outlines.rays], signature)
            candidates.outlines = outlines
        beside_sketch = give_up > 0.0  # it is better at what is hard here
        least = _WORTH_REFINING if beside_sketch else 0.0
        most = _RETRIEVED_FIRST if brief or beside_sketch else _RETRIEVED
        keep = _REFINED_OF_VOTED if brief else _REFINED
        rotations, centres = self._voted(outlines, _RETRIEVED, candidates.sky)
        if self._forest_scores is not None and candidates.sky.dark:
            agreed = self._agreed(candidates, rotations, centres, least)
            if agreed is not None:
                agreed = self._beside_look_alikes(candidates, agreed)
                return self.levels.finished(agreed, image, sky)
        candidates.refine_best(rotations[:most], centres[:most], keep, least=least)
        if brief:
            return self.levels.finished(candidates.choose(), image, sky)
        best = candidates.most_inliers
        if best is not None:
            self._half_turned(candidates, best.pose, best.inlier_ratio)
        return self._answer(candidates, image, sky, give_up)

    def _answer(
        self, candidates: Candidates, image: Picture, sky: Sky, give_up: float,
        sketched: Found | None = None,
    ) -> Found | None:  # fmt: skip
        """The likeliest of all poses, beside look-alikes if its confidence reaches ``give_up``."""
        found = self._settled(candidates)
        if found is not None and found.confidence >= give_up:
            found = self._beside_look_alikes(candidates, found, sketched)
        return self.levels.finished(found, image, sky)

    def _settled(self, candidates: Candidates) -> Found | None:
        """The best pose, or the best of those around it as long as it is not sure."""
        found = candidates.choose()
        for _ in range(_MOST_ASKED):
            if found is None or found.confidence >= _ENDS:
                break
            before = found.best.pose
            self._around(candidates, before)
            found = candidates.choose()
            if found is None or found.best.pose is before:
                break
        return found

    def _beside_look_alikes(
        self, candidates: Candidates, found: Found | None, sketched: Found | None = None
    ) -> Found | None:
        """The likeliest pose after each look-alike of the best has had one alignment."""
        rivals = candidates.level.rivals
        if rivals is None or found is None:
            return found
        asked: list[Pose] = []

        def ask(best: Hypothesis) -> bool:
            """Align the look-alikes of a pose, unless they have been."""
            if best.pose in asked:
                return False
            asked.append(best.pose)
            least = best.inlier_ratio - _MOST_BEHIND
            alike = rivals.look_alikes(best.pose, candidates.reach_rad)
            candidates.refine_closely(filter(candidates.may_be, alike), least=least)
            return True

        ask(found.best)
        on_sketch = None
        if sketched is not None:
            # Grey edges have no hold there: it has their least merit.
            candidates.add([replace(sketched.best, outline=0.0, inner=0.0)])
            on_sketch = sketched.aligned
        found = candidates.weighed(on_sketch)
        for _ in range(_MOST_ASKED):  # edges, or pictures, speak for another
            if found is None or not ask(found.best):
                break
            found = candidates.weighed(on_sketch)
        return found

    def _voted(self, outlines: Outlines, most: int, sky: Sky) -> tuple[Array, Array]:
        """Starting poses in the order of similarity and votes together, likeliest first."""
        signature = outlines.signature
        rotations, centres = self._retrieval.of(signature, most, sky.sun_camera)
        if self._forest_scores is None:
            return rotations, centres
        scores = self._forest_scores.scores(signature, rotations)
        order = np.argsort(-likely(scores), kind="stable")
        return rotations[order], centres[order]

    def _agreed(
        self, candidates: Candidates, rotations: Array, centres: Array, least: float
    ) -> Found | None:
        """The pose on which edges and forest agree, from the likeliest starts; None without one."""
        first = slice(0, _VOTED_FIRST)
        starts = rotations[first].copy(), centres[first].copy()
        candidates.refine_best(*starts, _REFINED_OF_VOTED, least=least)
        found = candidates.choose()
        if found is None or found.confidence < _ENDS or found.votes is None:
            return None
        return found if found.votes >= _LEAST_VOTES else None

    def at(
        self, image: Picture, sky: Sky, near: Near, sufficient_inlier_ratio: float = 1.0
    ) -> Found | None:
        """The pose next to a prior that is right to a few degrees; None unless it is confident.

        ``sufficient_inlier_ratio`` lowers what is enough otherwise: a search has confirmed it, and
        the prior speaks for it, too.
        """
        usual = _ENOUGH if sky.dark else _ENOUGH_BRIGHT
        prior = near.prior
        single = self._candidates(image, sky, prior, None, near)
        refined = single.level.refiner.refine(single.image, single.sky, prior)
        if refined is None or refined.inlier_ratio < min(sufficient_inlier_ratio, usual):
            return None
        single.add_next_to(prior, refined)
        reaches_usual = refined.inlier_ratio >= usual
        found = single.choose(shade=not reaches_usual)
        if reaches_usual and found is not None and found.confidence < _CONFIDENT:
            found = single.choose()
        least = _CONFIRMED if refined.inlier_ratio >= sufficient_inlier_ratio else _CONFIDENT
        if found is None or found.confidence < least:
            return None
        if found.best.pose.angle_to(prior) > CLOSE_RAD:  # else the prior speaks for it
            if not reaches_usual:
                return None
            found = self._beside_look_alikes(single, found) or found
        return self.levels.finished(replace(found, single=True), image, sky)

    def posterior(self, image: Picture, sky: Sky, pose: Pose) -> float:
        """Probability of a pose among its look-alikes, by their edges and drawings."""
        candidates = self._candidates(image, sky, pose, None)
        candidates.refine_closely([pose])
        found = self._beside_look_alikes(candidates, candidates.choose())
        if found is None or not found.weighed:
            return 1.0
        return share_of(pose, found.weighed, self.model.symmetries)

    def proposed(
        self, image: Picture, sky: Sky, proposals: list[Pose], outlines: Outlines | None, *,
        half_turns: bool = True, sketched: Found | None = None, give_up: float = 0.0,
        near: Near | None = None,
    ) -> Found | None:  # fmt: skip
        """The best of some poses that another estimator proposes, and of half turns of it.

        Args:
            proposals: right to a few degrees, or another answer; the first tells the size.
            half_turns: ``False`` where the second estimator has ruled them out.
            sketched: what a sketch shows; it is weighed, too.
            give_up: confidence that the proposals must reach, else their look-alikes are not tried.
            near: where the answer is.
        """
        candidates = self._candidates(image, sky, proposals[0], outlines, near)
        candidates.refine_next_to(proposals)
        if half_turns:
            best = candidates.most_inliers
            pose, inliers = (proposals[0], 0.0) if best is None else (best.pose, best.inlier_ratio)
            self._half_turned(candidates, pose, inliers)
        return self._answer(candidates, image, sky, give_up, sketched)

    def near(
        self, image: Picture, sky: Sky, near: Near, outlines: Outlines | None, *,
        give_up: float = 0.0,
    ) -> Found | None:  # fmt: skip
        """The pose within some angle of a prior, from rotations of it."""
        rotations, centres = rotated_about(near.prior, self.model.centre_m, near.error_rad)
        candidates = self._candidates(image, sky, near.prior, outlines, near)
        candidates.refine_next_to([near.prior])
        candidates.refine_best(rotations, centres, _REFINED_NEAR)
        return self._answer(candidates, image, sky, give_up)

    def _around(self, candidates: Candidates, best: Pose) -> None:
        """Add poses from 9° around, nearer and farther, too: the best may be a local optimum."""
        rotations, centres = rotated_about(best, self.model.centre_m, _ASIDE_RAD)
        there = np.concatenate([times * centres for times in _ASIDE_RANGES])
        turned = np.tile(rotations, (len(_ASIDE_RANGES), 1, 1))
        candidates.refine_best(turned, there, _KEPT_ASIDE)
        candidates.refine_closely([best])

    def _half_turned(self, candidates: Candidates, pose: Pose, inliers: float) -> None:
        """Add poses from half turns of one: many craft look nearly alike from behind or below.

        ``inliers``: inlier ratio of the pose.
        """
        turned = rotated_by(pose, self._half_turns, self.model.centre_m)
        candidates.refine(turned, least=inliers - _MOST_BEHIND)
