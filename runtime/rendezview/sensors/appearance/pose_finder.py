"""The pose of one configuration of a target in a frame: by outline, by edges, on a sketch."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rendezview.estimation.hypotheses import best_by, choose
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.by_outline import OutlineRecognition, Traced
from rendezview.sensors.appearance.edges.alignment import NEAREST_RADII
from rendezview.sensors.appearance.edges.refinement import RefineOptions
from rendezview.sensors.appearance.hypothesis import Bound
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.judge.rivals import RIVAL_RAD, Rivals
from rendezview.sensors.appearance.judge.sketch_choice import NEAR_RAD
from rendezview.sensors.appearance.model.joint_angles import JointAngles
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import (
    CLOSE_MARGIN,
    AppearanceObservation,
    StageClock,
)
from rendezview.sensors.appearance.outline.silhouette import SilhouetteOptions
from rendezview.sensors.appearance.outline.votes import MatchOptions
from rendezview.sensors.appearance.region import Region
from rendezview.sensors.appearance.scale import Scale
from rendezview.sensors.appearance.search.close import CloseSearch
from rendezview.sensors.appearance.search.search import PoseSearch
from rendezview.sensors.appearance.search.sketch_search import SketchSearch
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.appearance.verdict import (
    LEAST_POSTERIOR,
    beside_look_alikes,
    contradicted,
    contradiction,
    has_range,
    refused,
)
from rendezview.sensors.observation import Status

# Confidence of the likeliest starts: with less, they propose nothing beside a sketch, and
# look-alikes of what a sketch in doubt proposes are not tried.
# Source: by hand, seeds 5 and 6 of rendezview simulate --trajectory random
_LEAST_CONFIDENT = 0.1
# Confidence of grey edges below which a sketch is asked, too: of 1,021 poses from 0.6 on, of craft
# left out, 12 are wrong, eight of the 101 below it. Source: confidence-fit
_SURE = 0.9
# Probability of a pose; with less, it is held for wrong.
# Source: by construction
_HELD_FOR_WRONG = 0.5
# merit; chance decides between two poses nearer to each other, where no look-alike was drawn.
# Source: pose-accuracy, seed 77
_LEAST_MARGIN = 0.01
# Rad; a pose that is further off is wrong. Source: the limit in the experiments
_WRONG_RAD = np.deg2rad(10.0)
# Bodies of a frame that are looked at closely. Source: Mitsuba frames before the Earth: of 120 with
# two bodies 97 are right, with four 102 (docs/notes/photographs.md)
_BODIES = 4
# Of the risk that a pose is wrong: each of them is one more chance of it. Source: drawn walls with
# a hidden box, at 1 two wrong poses of 24; of 14 right photographs of objects none is lost
_RISK_OF_EACH = 0.75


class Request(NamedTuple):
    """What ``recognize`` is asked of one frame; see there."""

    frame: Picture
    prior: Pose | None
    prior_error_rad: float | None
    sun_camera: npt.ArrayLike | None
    enough_inliers: float
    thorough: bool = False  # in windows, too


class PoseFinder:
    """Finds the pose of one configuration of a model in the frames of one camera."""

    def __init__(
        self, model: ViewModel, camera: Camera, silhouette: SilhouetteOptions | None,
        match: MatchOptions | None, *, refine: bool, trees: bool, sketch: bool,
        least_confidence: float,
    ) -> None:  # fmt: skip
        """See ``Recognizer``."""
        self.model = model
        self.camera = camera
        self.trees = trees
        self.region: Region | None = None
        self.least_confidence = least_confidence
        self.search = PoseSearch(model, camera) if refine and model.contours is not None else None
        # Refinement has its own.
        self._rivals = None
        if self.search is None and model.shape is not None:
            self._rivals = Rivals(model, camera)
        self.close = None
        if self.search is not None and model.near:
            self.close = CloseSearch(model, camera)
        if silhouette is None and self.search is not None:
            # Shadow cuts a body into pieces; refinement decides whether they are the target's.
            silhouette = SilhouetteOptions(rival_fraction=2.0, merge_gap=0.6)
        self.outline = OutlineRecognition(model, camera, silhouette or SilhouetteOptions(), match)
        self.sketch = None
        # A sketch shows one angle of the joints only.
        sketch = sketch and not model.joints
        if sketch and self.search is not None and model.sketches is not None:
            views, sketcher = self.search.refiner.views, self.outline.sketcher
            self.sketch = SketchSearch(model, camera, views, sketcher)
        self.prior_error_rad = self.outline.matcher.options.prior_error_rad

    def looking_at(self, region: Region) -> PoseFinder:
        """The same in a part of the camera's frames: nothing else is looked at."""
        other = self._with_camera(region.seen_by(self.camera), region)
        other.region = region
        return other

    def seeing(self, scale: Scale) -> PoseFinder:
        """The same in frames that are as blurred, which are looked at in a smaller size."""
        camera = self.camera.binned(scale.times)
        return self._with_camera(camera, None, RefineOptions(blur_px=scale.blur_px))

    def _with_camera(
        self, camera: Camera, region: Region | None, options: RefineOptions | None = None
    ) -> PoseFinder:
        """The same in the frames of another camera; in a region of them, if one is given."""
        other = copy(self)
        other.camera = camera
        bounds: tuple[Bound, ...] = ()
        if region is not None:
            bounds = (partial(region.shows, self.model, camera),)
        other.outline = self.outline.with_camera(camera, region)
        if self.search is not None:
            other.search = self.search.with_camera(camera, *bounds, options=options)
        if self._rivals is not None:
            other._rivals = self._rivals.with_camera(camera)
        if self.close is not None:
            other.close = CloseSearch(self.model, camera)
        if self.sketch is not None and other.search is not None:
            views = other.search.refiner.views
            other.sketch = self.sketch.with_tables(self.model, views, camera)
            other.sketch.bounds = (*self.sketch.bounds, *bounds)
            other.sketch.box = None if region is None else region.box_in_part
        return other

    def judged(self, seen: AppearanceObservation) -> AppearanceObservation:
        """The observation with its found pose given or refused."""
        assert seen.found is not None
        if self._confident(seen.found):
            return self._given(seen, seen.found)
        return refused(seen, seen.found)

    def find(self, request: Request) -> AppearanceObservation:
        """What is observed in one frame."""
        frame, prior, prior_error_rad, sun_camera, enough_inliers, thorough = request
        clock, search = StageClock(), self.search
        if search is None:
            traced = self.outline.trace(frame, prior, clock, bright_sky=False)
            seen = self.outline.recognize(traced, prior, prior_error_rad, clock, alone=True)
            if prior is None and seen.pose is not None and self._rivals is not None:
                sky = Sky.of(frame, sun_camera)
                weighed = self._rivals.weigh_coarse(frame, sky, seen.pose)
                seen = beside_look_alikes(seen, weighed, self.model.symmetries)
                clock.lap("look-alikes")
            return seen
        sky = Sky.of(frame, sun_camera)
        if prior is None:
            seen = self._anywhere(search, frame, sky, clock)
            cluttered = not sky.dark or self.region is not None  # several things, anyway
            look_further = cluttered and thorough and seen.pose is None
            if look_further and not self._open(seen.found):
                return self._among_others(seen, request)
            return seen
        near = Near(prior, prior_error_rad or self.prior_error_rad, self.model.centre_m)
        close = self._next_to(search, frame, sky, near, enough_inliers, clock)
        return close or self._near(search, frame, sky, near, clock)

    def _anywhere(
        self, search: PoseSearch, frame: Picture, sky: Sky, clock: StageClock
    ) -> AppearanceObservation:
        """Without a prior: by the outline, then on a sketch."""
        traced = self.outline.trace(frame, None, clock, bright_sky=not sky.dark)
        alone = self._alone(sky)
        found = None
        if alone and traced.outlines is not None:
            give_up = 0.0 if self.sketch is None else _LEAST_CONFIDENT
            found = search.anywhere(frame, sky, traced.outlines, give_up=give_up)
            clock.lap("refine")
        given, surer, sketched = self._decided(search, frame, sky, traced, found, None, clock)
        doubt = None
        if given is not None and sketched is not None and not alone:
            doubt = contradiction(given, sketched, self.model.symmetries)
        if given is not None and doubt is None:
            return self._given(self.outline.seen(traced, given.best.pose, clock), given)
        seen = refused(self.outline.recognize(traced, None, None, clock), surer, dark=sky.dark)
        if doubt is None or self.region is None:
            return seen
        return contradicted(seen, doubt, boxed=not self.region.is_open)

    def _alone(self, sky: Sky) -> bool:
        """Whether one estimator is enough without a prior.

        In a window of a bright frame other things have edges, too: two must agree.
        """
        return sky.dark or self.sketch is None or self.region is None

    def _decided(
        self, search: PoseSearch, frame: Picture, sky: Sky, traced: Traced, found: Found | None,
        near: Near | None, clock: StageClock,
    ) -> tuple[Found | None, Found | None, Found | None]:  # fmt: skip
        """What grey edges show, beside a sketch where they are in doubt.

        Returns:
            The one to give, if any; the surer one; and what the sketch shows.
        """
        given = found if self._confident(found) else None
        if self.sketch is None or (given is not None and given.confidence >= _SURE):
            return given, found, None
        if near is None:
            sketched = self.sketch.best(frame, sky, traced.sketch)
        else:
            sketched = near.bounded(self.sketch.near(frame, sky, near))
        clock.lap("sketch")
        likely = sketched is not None and sketched.confidence >= _HELD_FOR_WRONG
        if near is None and not likely and not self._alone(sky):
            return None, sketched, sketched  # grey edges alone were not asked
        if sketched is not None:
            # Grey edges judge what the sketch proposes, and are the finer ones.
            answers = sketched.answers
            if found is not None and found.confidence >= _LEAST_CONFIDENT:
                answers += found.answers
            doubted = not self._confident(sketched) or sketched.margin < CLOSE_MARGIN
            proposed = search.proposed(
                frame, sky, answers, traced.outlines, half_turns=doubted, sketched=sketched,
                give_up=0.0 if likely else _LEAST_CONFIDENT, near=near,
            )  # fmt: skip
            found = found if proposed is None else proposed
        given, surer = self._chosen(search, frame, sky, found, sketched)
        clock.lap("refine")
        return given, surer, sketched

    def _among_others(self, seen: AppearanceObservation, request: Request) -> AppearanceObservation:
        """The pose of the body that is the target, where a frame is full of other things.

        Args:
            seen: what the whole frame showed: no pose.
        """
        if self.sketch is None:
            return seen
        clock = StageClock()
        looks = []
        may_be = None if self.region is None else self.region.holds
        for body in self.sketch.bodies(request.frame, _BODIES, may_be):
            region = Region.around(body.box_px, self.camera)
            part = request._replace(frame=region.cut(request.frame), thorough=False)
            finder = self.looking_at(region)
            finder.least_confidence = 1.0 - _RISK_OF_EACH * (1.0 - self.least_confidence)
            looks.append(region.in_frame(finder.find(part)))
        clock.lap("windows")  # with all looks
        seen.stage_ms.update(clock.stage_ms)
        given = [(look, look.pose) for look in looks if look.pose is not None]

        def same(k: int, known: int) -> bool:
            apart = angle_between(given[k][1], given[known][1], self.model.symmetries)
            return bool(apart <= NEAR_RAD)

        choice = choose([look.score for look, _ in given], same)
        if choice is not None and choice.rivals:
            reason = f"{len(given)} bodies look like the target: give a box around it (roi)"
            return replace(seen, status=Status.RIVALS, reason=reason)
        if choice is not None:
            best = given[choice.best][0]
        else:  # the likeliest says why there is none
            likely = [one for one in looks if one.found is not None] or [seen]
            best = max(likely, key=lambda one: one.confidence or 0.0)
            if self.region is None or self.region.is_open:
                reason = f"{best.reason}; if this is not the target, give a box around it (roi)"
                best = replace(best, reason=reason)
        return replace(best, stage_ms=seen.stage_ms)

    def _next_to(
        self, search: PoseSearch, frame: Picture, sky: Sky, near: Near, enough_inliers: float,
        clock: StageClock,
    ) -> AppearanceObservation | None:  # fmt: skip
        """The pose next to a prior; None unless it is confident at once."""
        if self.close is not None:
            found = near.bounded(self.close.at(frame, sky, near.prior, enough_inliers))
            clock.lap("refine")
            if found is not None:
                return self._given(AppearanceObservation(Status.OK, stage_ms=clock.stage_ms), found)
        found = near.bounded(search.at(frame, sky, near, enough_inliers))
        clock.lap("refine")
        if found is None or not self._confident(found):
            return None
        seen = AppearanceObservation(Status.OK, stage_ms=clock.stage_ms)
        if self.trees:
            pose, bright = found.best.pose, not sky.dark
            seen = self.outline.seen_from(frame, pose, clock, bright_sky=bright)
        return self._given(seen, found)

    def _near(
        self, search: PoseSearch, frame: Picture, sky: Sky, near: Near, clock: StageClock
    ) -> AppearanceObservation:
        """Within the error of a prior: by rotations of it, then on a sketch.

        A sketch of its own for the outline before a bright sky would show nothing more.
        """
        prior, error_rad = near.prior, near.error_rad
        traced = self.outline.trace(frame, prior, clock, bright_sky=False)
        if self.overflows(prior):
            return refused(self.outline.recognize(traced, prior, error_rad, clock), None)
        give_up = 0.0 if self.sketch is None else _LEAST_CONFIDENT
        found = near.bounded(search.near(frame, sky, near, traced.outlines, give_up=give_up))
        clock.lap("refine")
        given, surer, _ = self._decided(search, frame, sky, traced, found, near, clock)
        given = near.bounded(given)
        if given is None:
            view = self.outline.recognize(traced, prior, error_rad, clock)
            return refused(view, surer, dark=sky.dark)
        if not sky.dark and self.trees:
            view = self.outline.seen_from(frame, given.best.pose, clock, bright_sky=True)
        else:
            view = self.outline.seen(traced, given.best.pose, clock)
        return self._given(view, given)

    def _chosen(
        self, search: PoseSearch, frame: Picture, sky: Sky, found: Found | None,
        sketched: Found | None,
    ) -> tuple[Found | None, Found | None]:  # fmt: skip
        """Of what grey edges and a sketch show the one to give, if any, and the surer one."""
        if sketched is not None and found is not None and found.weighed:
            sketched = sketched.beside(found.weighed, self.model.symmetries)
        answers = [one for one in (sketched, found) if one is not None]
        sure = list(filter(self._confident, answers))
        given = next(iter(sure), None)  # of one answer the sketch's: hard light moves grey edges
        if len(sure) > 1:
            first, second = (one.best.pose for one in sure)
            if angle_between(first, second, self.model.symmetries) > RIVAL_RAD:
                given = best_by(lambda one: one.confidence, sure)
        if given is not None and given is sketched:
            # Grey edges are the finer ones, where they are seen: alone, or as the sketch confirms.
            there = Near(given.best.pose, NEAR_RAD, self.model.centre_m)
            finer = search.at(frame, sky, there)
            if finer is not None and found is not None and found.weighed:
                alone = finer.known_among(found.weighed, self.model.symmetries)
                finer = alone if self._confident(alone) else None
            if finer is None and found is not None and found.confidence >= _HELD_FOR_WRONG:
                finer = given.confirming(found, self.model.symmetries)
            given = finer or given
        return given, best_by(lambda one: one.confidence, answers)

    def overflows(self, pose: Pose) -> bool:
        """Whether a target there is too near for a whole view: no search near it can find one."""
        depth_m = pose.apply(self.model.centre_m)[2]
        return bool(depth_m < NEAREST_RADII * self.model.target_radius_m)

    def _open(self, found: Found | None) -> bool:
        """Whether the target is there, and only its look-alikes leave the pose open."""
        if found is None or len(found.weighed) < 2:
            return False
        return found.confidence >= self.least_confidence and found.posterior < LEAST_POSTERIOR

    def _given(self, seen: AppearanceObservation, found: Found) -> AppearanceObservation:
        """The observation with the refined pose."""
        best, joints = found.best, None
        if best.angles_rad is not None and best.joint_covariance is not None:
            joints = JointAngles(self.model.joints, best.angles_rad, best.joint_covariance)
        return replace(
            seen,
            status=Status.OK,
            reason=None,
            pose=best.pose,
            covariance=best.covariance,
            confidence=found.right,
            joints=joints,
            found=found,
        )

    def _confident(self, found: Found | None) -> bool:
        """Whether a pose is given: it is likely right, and without a prior it has no rival."""
        if found is None:
            return False
        if found.weighed:
            close = found.posterior < LEAST_POSTERIOR
        else:
            close = found.rival is not None and not found.prior and found.margin < _LEAST_MARGIN
        surely = found.confidence * found.share_within(_WRONG_RAD)
        return surely >= self.least_confidence and not close and has_range(found.best)
