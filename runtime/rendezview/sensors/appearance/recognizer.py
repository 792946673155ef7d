"""The recognizer: takes a frame and gives an observation, by outline and by edges."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import nearest_alike
from rendezview.io.grey_frame import Picture, check_frame
from rendezview.sensors.appearance.by_outline import OutlineRecognition
from rendezview.sensors.appearance.edges.alignment import NEAREST_RADII
from rendezview.sensors.appearance.edges.articulation import LEAST_SUPPORT
from rendezview.sensors.appearance.edges.refinement import Refined
from rendezview.sensors.appearance.integrity.evidence import Second
from rendezview.sensors.appearance.joint_configurations import around, best_of
from rendezview.sensors.appearance.judge.confidence import Found
from rendezview.sensors.appearance.judge.sketch_found import SketchFound
from rendezview.sensors.appearance.model.joint_angles import JointAngles
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import (
    CLOSE_MARGIN,
    AppearanceObservation,
    StageClock,
)
from rendezview.sensors.appearance.outline.silhouette import SilhouetteOptions
from rendezview.sensors.appearance.outline.votes import MatchOptions
from rendezview.sensors.appearance.search.close import CloseSearch
from rendezview.sensors.appearance.search.levels import LevelSearch
from rendezview.sensors.appearance.search.sketch_search import SketchSearch
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.observation import Status

# Of the outline: it was whole, and refinement says why there is no pose.
_WHOLE_OUTLINE = (Status.OK, Status.AMBIGUOUS, Status.UNRECOGNIZED)
# Rad; error of a pose whose joint is at a wrong angle. Source: experiment pose-joints (0.1)
_NEAR_RAD = np.deg2rad(8.0)
# Confidence: with less after the likeliest starts, a sketch is tried before all others. Of 79
# frames of Hubble, Sun 30° and 60° aside, 4 have less although grey edges find their pose at last.
# Source: by hand, seeds 5 and 6 of rendezview simulate --trajectory random
_LEAST_CONFIDENT = 0.1
# Configurations of a target with joints that are searched whole. Source: pose-joints (0.1)
_CONFIGURATIONS = 3
# Of a pose among its look-alikes.
_LEAST_POSTERIOR = 0.9
# merit; chance decides between two poses nearer to each other, where no look-alike was drawn.
# Source: pose-accuracy, seed 77
_LEAST_MARGIN = 0.01
# Rad, and of the range: one σ. Beyond, the frame leaves the pose open and no linear covariance
# tells how far. Source: by construction
_MOST_SIGMA = 0.5


class _Request(NamedTuple):
    """What ``recognize`` is asked of one frame; see there."""

    frame: Picture
    prior: Pose | None
    prior_error_rad: float | None
    sun_camera: npt.ArrayLike | None
    enough_inliers: float


class Recognizer:
    """Recognises the views of one model in the frames of one camera.

    Threads may share an instance: their frames are processed one after the other.
    """

    def __init__(
        self,
        model: ViewModel,
        camera: Camera,
        silhouette: SilhouetteOptions | None = None,
        match: MatchOptions | None = None,
        *,
        refine: bool = True,
        trees: bool = True,
        sketch: bool = True,
        least_confidence: float = 0.6,
    ) -> None:
        """A recognizer of one model in the frames of one camera.

        Args:
            model: of the target.
            camera: that takes the frames.
            silhouette: what counts as the target.
            match: how the trees are evaluated.
            refine: move poses onto the edges of the frame, if the model has contour points.
            trees: find the active nodes, when they are asked for, even where refinement from the
                prior is confident.
            sketch: where the grey edges give no confident pose, search on a sketch that a network
                draws of the frame, if the model has sketches of its views.
            least_confidence: a refined pose of less confidence is not given.
        """
        self.model = model
        self.camera = camera
        self.trees = trees
        self.least_confidence = least_confidence
        self.search = LevelSearch(model, camera) if refine and model.contours is not None else None
        self.close = None
        if self.search is not None and model.near:
            self.close = CloseSearch(model, camera)
        self.sketch = None
        # A sketch shows one angle of the joints only.
        sketch = sketch and not model.joints
        if sketch and self.search is not None and model.sketches is not None:
            self.sketch = SketchSearch(model, camera, self.search.refiner.views)
        if silhouette is None and self.search is not None:
            # Shadow cuts a body into pieces; refinement decides whether they are the target's.
            silhouette = SilhouetteOptions(rival_fraction=2.0, merge_gap=0.6)
        self.outline = OutlineRecognition(model, camera, silhouette or SilhouetteOptions(), match)
        self.prior_error_rad = self.outline.matcher.options.prior_error_rad
        # The same target with its joints at other angles.
        self._others = tuple(
            Recognizer(
                one, camera, silhouette, match, refine=refine, trees=trees,
                least_confidence=least_confidence,
            )
            for one in model.configurations
        )  # fmt: skip
        self._lock = threading.Lock()

    def recognize(
        self,
        image: npt.ArrayLike,
        prior: Pose | None = None,
        prior_error_rad: float | None = None,
        sun_camera: npt.ArrayLike | None = None,
        enough_inliers: float = 1.0,
        *,
        angles_rad: npt.ArrayLike | None = None,
        time_s: float | None = None,
    ) -> AppearanceObservation:
        """Look at one frame.

        Args:
            image: (H, W) uint8 grey levels, of the camera's size.
            prior: camera_from_target, roughly. Refinement starts from it, and it chooses among
                several bodies. ``None``: all attitudes are searched, and a view that fits two
                of them gives ``AMBIGUOUS``.
            prior_error_rad: how far off the prior's attitude may be; default 20°.
            sun_camera: (3,) towards the Sun, camera frame, if it is known.
            enough_inliers: inlier ratio at which the pose next to the prior is accepted without
                another search, where it is below that of the search's options.
            angles_rad: (J,) of the joints with the prior, to a few degrees; ``None``: unknown.
            time_s: when the frame was taken; the observation carries it.

        Raises:
            ValueError: the direction to the Sun is zero or not finite.
            RendezviewError: the image is no 8-bit grey picture of the camera's size.
        """
        frame = check_frame(image, self.camera.width, self.camera.height)
        with self._lock:
            request = _Request(frame, prior, prior_error_rad, sun_camera, enough_inliers)
            if self.model.joints and self.search is not None:
                seen = self._of_configurations(request, angles_rad)
            else:
                seen = self._recognize(*request)
        return seen if time_s is None else replace(seen, time_s=time_s)

    def _of_configurations(
        self, request: _Request, angles_rad: npt.ArrayLike | None
    ) -> AppearanceObservation:
        """The observation of the configuration next to the angles, or the best of all."""
        searched = every = (self, *self._others)
        models = [one.model for one in every]

        def at(angles: Array) -> Recognizer:
            return every[models.index(self.model.configuration_at(angles))]

        if request.prior is not None and angles_rad is not None:
            angles = np.array(angles_rad, dtype=np.float64).reshape(len(self.model.joints))
            seen = at(angles)._turned_to(angles, request, tracked=True)
            if seen.found is None or seen.found.best.joint_support >= LEAST_SUPPORT:
                return seen
            # The parts are elsewhere, or hidden.
            others = around(self.model.joints, angles) + [model.angles_rad for model in models]
            again = [at(other)._turned_to(other, request) for other in others]
            return best_of([seen, *again], models, self._judged)
        observations: list[AppearanceObservation] = []
        if request.prior is None:
            searched, observations = self._likely(searched, request)
        observations += [one._turned_to(one.model.angles_rad, request) for one in searched]
        best = best_of(observations, models, self._judged)
        if best.found is None or best.found.best.angles_rad is None:
            return best
        # Edges of a part may have led to a local optimum of its angle.
        near = request._replace(prior=best.found.best.pose, prior_error_rad=_NEAR_RAD)
        others = around(self.model.joints, best.found.best.angles_rad)
        again = [at(angles)._turned_to(angles, near) for angles in others]
        return best_of([*observations, *again], models, self._judged)

    def _likely(
        self, searched: tuple[Recognizer, ...], request: _Request
    ) -> tuple[tuple[Recognizer, ...], list[AppearanceObservation]]:
        """The configurations that fit best after a brief search, and what the others observed."""
        frame, sky = request.frame, Sky.of(request.frame, request.sun_camera)
        traced = self.outline.trace(frame, None, StageClock(), bright_sky=not sky.dark)
        merits, observations = [], []
        for one in searched:
            assert one.search is not None
            one.search.start_at(one.model.angles_rad)
            found = None
            if traced.outlines:
                found = one.search.anywhere(frame, sky, traced.outlines, sky.sun_camera, brief=True)
            merits.append(-np.inf if found is None else found.merit)
            observations.append(AppearanceObservation(Status.LOST, found=found))
        order = np.argsort(-np.array(merits), kind="stable")
        chosen, others = order[:_CONFIGURATIONS], order[_CONFIGURATIONS:]
        return tuple(searched[k] for k in chosen), [observations[k] for k in others]

    def _turned_to(
        self, angles_rad: Array, request: _Request, *, tracked: bool = False
    ) -> AppearanceObservation:
        """The observation of this configuration, with the joints starting at some angles (J,)."""
        assert self.search is not None
        self.search.start_at(angles_rad, tracked=tracked)
        return self._recognize(*request)

    def _judged(self, seen: AppearanceObservation) -> AppearanceObservation:
        """The observation with its found pose given or refused."""
        assert seen.found is not None
        if self._confident(seen.found):
            return self._given(seen, seen.found)
        return _refused(seen, seen.found)

    def second_estimate(self, image: npt.ArrayLike, pose: Pose) -> Second | None:
        """The pose that the sketch of a frame shows, searched without a prior, beside another one.

        It takes a seventh of a second. ``None``: there is no sketch, or no pose on it.
        """
        if self.sketch is None:
            return None
        frame = check_frame(image, self.camera.width, self.camera.height)
        with self._lock:
            choice = self.sketch.anywhere(frame, Sky.of(frame))
        if choice is None:
            return None
        other = nearest_alike(choice.pose, pose, self.model.symmetries)
        return Second(other.angle_to(pose), choice.confidence)

    def _recognize(
        self,
        frame: Picture,
        prior: Pose | None,
        prior_error_rad: float | None,
        sun_camera: npt.ArrayLike | None,
        enough_inliers: float,
    ) -> AppearanceObservation:
        clock, search = StageClock(), self.search
        if search is None:
            traced = self.outline.trace(frame, prior, clock, bright_sky=False)
            return self.outline.recognize(traced, prior, prior_error_rad, clock, alone=True)
        sky = Sky.of(frame, sun_camera)
        error_rad = prior_error_rad or self.prior_error_rad
        found = None
        if prior is not None and self.close is not None:
            found = self.close.at(frame, sky, prior, enough_inliers)
            clock.lap("refine")
            if found is not None:
                return self._given(AppearanceObservation(Status.OK, stage_ms=clock.stage_ms), found)
        if prior is not None:
            found = search.at(frame, sky, prior, error_rad, enough_inliers)
            clock.lap("refine")
            if found is not None and self._confident(found):
                seen = AppearanceObservation(Status.OK, stage_ms=clock.stage_ms)
                if self.trees:
                    pose, bright = found.best.pose, not sky.dark
                    seen = self.outline.seen_from(frame, pose, clock, bright_sky=bright)
                return self._given(seen, found)
        traced = self.outline.trace(frame, prior, clock, bright_sky=not sky.dark)
        if prior is None and traced.outlines:
            least = 0.0 if self.sketch is None else _LEAST_CONFIDENT
            found = search.anywhere(frame, sky, traced.outlines, sky.sun_camera, give_up=least)
            clock.lap("refine")
            if found is not None and self._confident(found):
                return self._given(self.outline.seen(traced, found.best.pose, clock), found)
        traced_view = None
        if found is None and prior is not None:
            traced_view = self.outline.recognize(traced, prior, prior_error_rad, clock)
            if self.overflows(prior):
                return _refused(traced_view, None)
            also = [] if traced_view.pose is None else [traced_view.pose]
            found = search.near(frame, sky, prior, error_rad, traced.outlines, also)
            clock.lap("refine")
            if found is not None and self._confident(found):
                return self._given(traced_view, found)
        if self.sketch is not None:
            sketched = self._sketched(self.sketch, frame, sky, prior, error_rad)
            clock.lap("sketch")
            doubtful = found is None or found.confidence < _LEAST_CONFIDENT
            if sketched is not None and prior is None:
                # Grey edges judge what the sketch proposes, and are the finer ones.
                answers = sketched.answers + ([] if found is None or doubtful else found.answers)
                doubted = not self._confident(sketched) or sketched.margin < CLOSE_MARGIN
                bodies = traced.outlines
                proposed = search.proposed(frame, sky, answers, bodies, half_turns=doubted)
                clock.lap("refine")
                if proposed is not None and self._confident(proposed):
                    pose = proposed.best.pose
                    return self._given(self.outline.seen(traced, pose, clock), proposed)
                if proposed is not None and proposed.weighed:
                    found = proposed
            if sketched is not None and self._confident(sketched) and _agree(found, sketched):
                pose = sketched.best.pose
                # Grey edges are the finer ones, where they are seen.
                closer = search.at(frame, sky, pose, _NEAR_RAD)
                clock.lap("refine")
                found = sketched if closer is None else closer
                return self._given(self.outline.seen(traced, pose, clock), found)
            if prior is None and traced.outlines and doubtful:
                found = search.anywhere(frame, sky, traced.outlines, sky.sun_camera, again=True)
                clock.lap("refine")
                if found is not None and self._confident(found):
                    return self._given(self.outline.seen(traced, found.best.pose, clock), found)
            weighed = found is not None and len(found.weighed) > 0
            if (
                sketched is not None
                and not weighed
                and (found is None or sketched.confidence > found.confidence)
            ):
                found = sketched
        if traced_view is None:
            traced_view = self.outline.recognize(traced, prior, prior_error_rad, clock)
        return _refused(traced_view, found)

    def overflows(self, pose: Pose) -> bool:
        """Whether a target there is too near for a whole view: no search near it can find one."""
        depth_m = pose.apply(self.model.centre_m)[2]
        return bool(depth_m < NEAREST_RADII * self.model.target_radius_m)

    def _sketched(
        self, search: SketchSearch, frame: Picture, sky: Sky, prior: Pose | None, error_rad: float
    ) -> SketchFound | None:
        """The best pose on a sketch of the frame."""
        if prior is None:
            choice = search.best(frame, sky)
        else:
            choice = search.near(frame, sky, prior, error_rad)
        return None if choice is None else SketchFound.of(choice, dark=sky.dark)

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
            confidence=found.confidence,
            joints=joints,
            found=found,
        )

    def _confident(self, found: Found) -> bool:
        """Whether a pose is given: it is likely right, and without a prior it has no rival."""
        if found.weighed:
            close = found.posterior < _LEAST_POSTERIOR
        else:
            close = found.rival is not None and not found.prior and found.margin < _LEAST_MARGIN
        return found.confidence >= self.least_confidence and not close and _is_known(found.best)


def _agree(weighed: Found | None, other: Found) -> bool:
    """Whether another pose is the likeliest beside its look-alikes, if they were asked."""
    if weighed is None or not weighed.weighed:
        return True
    apart = weighed.best.pose.angle_to(other.best.pose)
    return weighed.posterior >= _LEAST_POSTERIOR and apart < _NEAR_RAD


def _is_known(refined: Refined) -> bool:
    """Whether the edges of the frame determine the pose at all: σ of attitude and of range."""
    covariance, place_m = refined.covariance, refined.pose.translation_m
    range_m = float(np.linalg.norm(place_m))
    along_m2 = float(place_m @ covariance[3:, 3:] @ place_m) / max(range_m, 1e-9) ** 2
    turn_rad2 = float(np.trace(covariance[:3, :3]))
    return turn_rad2 < _MOST_SIGMA**2 and along_m2 < (_MOST_SIGMA * range_m) ** 2


def _refused(seen: AppearanceObservation, found: Found | None) -> AppearanceObservation:
    """The observation without a pose, and with the reason why refinement gives none."""
    status, reason = seen.status, seen.reason
    if found is None:
        if status in _WHOLE_OUTLINE:
            status, reason = Status.UNRECOGNIZED, "no pose of the target fits the edges"
    elif isinstance(found, SketchFound) and status not in _WHOLE_OUTLINE:
        pass  # the outline says why
    elif found.weighed and found.posterior < _LEAST_POSTERIOR:
        first, second = found.weighed[:2]
        apart = first.pose.angle_to(second.pose)
        status = Status.AMBIGUOUS
        reason = (
            f"{np.rad2deg(apart):.0f}° apart, two poses explain this frame with probabilities "
            f"{first.probability:.2f} and {second.probability:.2f}: give a prior, the Sun's "
            "direction, or more frames"
        )
    elif not found.weighed and found.rival is not None and found.margin < CLOSE_MARGIN:
        apart = found.best.pose.angle_to(found.rival.pose)
        status = Status.AMBIGUOUS
        reason = (
            f"two poses {np.rad2deg(apart):.0f}° apart fit this frame: "
            "give a prior, or look at more frames"
        )
    else:
        status = Status.LOST
        reason = (
            f"the best pose explains {100 * found.best.outline:.0f} % of its outline and "
            f"{100 * found.best.inner:.0f} % of its inner edges: too little to be confident"
        )
    return replace(
        seen,
        status=status,
        reason=reason,
        pose=None,
        covariance=None,
        confidence=None if found is None else found.confidence,
        joints=None,
        outline=replace(seen.reading, points_m=np.zeros((0, 3))),
        found=found,
    )
