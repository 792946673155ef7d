"""The recognizer: takes a frame and gives an observation, by outline and by edges."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import nearest_alike
from rendezview.io.grey_frame import Picture, check_frame
from rendezview.sensors.appearance.by_outline import OutlineRecognition
from rendezview.sensors.appearance.edges.articulation import LEAST_SUPPORT
from rendezview.sensors.appearance.integrity.evidence import Second
from rendezview.sensors.appearance.joint_configurations import around, best_of
from rendezview.sensors.appearance.judge.sketch_choice import NEAR_RAD
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation, StageClock
from rendezview.sensors.appearance.outline.silhouette import SilhouetteOptions
from rendezview.sensors.appearance.outline.votes import MatchOptions
from rendezview.sensors.appearance.pose_finder import PoseFinder, Request
from rendezview.sensors.appearance.region import Region, with_outline
from rendezview.sensors.appearance.scale import LEAST_PX, WHOLE, Scale
from rendezview.sensors.appearance.search.levels import radius_px
from rendezview.sensors.appearance.search.search import PoseSearch
from rendezview.sensors.appearance.search.sketch_search import SketchSearch
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.arguments import check_prior, check_types
from rendezview.sensors.observation import Status

# Configurations of a target with joints that are searched whole. Source: pose-joints (0.1)
_CONFIGURATIONS = 3


class Recognizer:
    """Recognises the views of a model; threads may share it: their frames take turns."""

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
            least_confidence: a refined pose that is less likely right to 10° is not given.
        """
        check_types("Recognizer(model, camera)", (model, ViewModel), (camera, Camera))
        self._made = partial(Recognizer, model, camera, silhouette, match, refine=refine,
            trees=trees, sketch=sketch, least_confidence=least_confidence)  # fmt: skip
        self.model = model
        self.camera = camera
        finder = partial(
            PoseFinder, camera=camera, silhouette=silhouette, match=match, refine=refine,
            trees=trees, least_confidence=least_confidence,
        )  # fmt: skip
        self._finder = finder(model, sketch=sketch)
        # The same target with its joints at other angles: a sketch shows one of them only.
        others = (finder(one, sketch=False) for one in model.configurations)
        self._finders = (self._finder, *others)
        self._seen_at: dict[Scale, tuple[PoseFinder, ...]] = {WHOLE: self._finders}
        self._lock = threading.Lock()

    @property
    def search(self) -> PoseSearch | None:
        """By grey edges; None where poses are not refined."""
        return self._finder.search

    @property
    def sketch(self) -> SketchSearch | None:
        """By the sketch of a frame; None where none is drawn."""
        return self._finder.sketch

    @property
    def outline(self) -> OutlineRecognition:
        """By the silhouette."""
        return self._finder.outline

    @property
    def trees(self) -> bool:
        """Whether active nodes are found beside a confident pose, too."""
        return self._finder.trees

    @property
    def least_confidence(self) -> float:
        """Of a pose that is given."""
        return self._finder.least_confidence

    @property
    def prior_error_rad(self) -> float:
        """How far off a prior may be, if nothing is said."""
        return self._finder.prior_error_rad

    def overflows(self, pose: Pose) -> bool:
        """Whether a target there is too near for a whole view: no search near it can find one."""
        return self._finder.overflows(pose)

    def __reduce__(self) -> tuple[Any, ...]:
        """Made anew where it is unpickled: the networks are read there."""
        return self._made, ()

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
        roi: npt.ArrayLike | Region | None = None,
        thorough: bool = True,
    ) -> AppearanceObservation:
        """Look at one frame.

        Args:
            image: (H, W) grey levels, or (H, W, 3) blue, green, red; see `check_frame`.
            prior: camera_from_target, its range right to a quarter. Refinement starts from it, and
                it chooses among several bodies. ``None``: all attitudes are searched, and a view
                that fits two of them gives ``AMBIGUOUS``.
            prior_error_rad: how far off the prior's attitude may be; default 20°. Its range may be
                off by as large a share as radians.
            sun_camera: (3,) towards the Sun, camera frame, if it is known.
            enough_inliers: inlier ratio at which the pose next to the prior is accepted without
                another search, where it is below the usual one.
            angles_rad: (J,) of the joints with the prior, to a few degrees; ``None``: unknown.
            time_s: when the frame was taken; the observation carries it.
            roi: where the whole target is: a box (4,) x, y, width, height, px, right to a fifth; a
                mask (H, W), not 0 on the target; a place on it (2,) x, y, px, or that and its
                range (3,) x, y, m, right to a quarter; or of ``place_of``. ``None``: anywhere.
            thorough: without a prior or a region, search a frame that shows other things in
                windows, too, where nothing else finds a pose. It takes a second or two.

        Raises:
            ValueError: the direction to the Sun is zero or not finite; the prior's error is not
                positive.
            RendezviewError: the image is no picture of the camera, or the region is none.
        """
        frame, near = check_frame(image, self.camera), check_prior(prior)
        if prior_error_rad is not None and not prior_error_rad > 0.0:
            raise ValueError(f"prior_error_rad must be positive: {prior_error_rad}")
        region = None
        if roi is not None:
            region = roi if isinstance(roi, Region) else Region.of(roi, self.camera)
        thorough = thorough and (region is None or region.is_open)
        request = Request(frame, near, prior_error_rad, sun_camera, enough_inliers, thorough)
        scale = self._scale(frame if region is None else region.cut(frame))
        with self._lock:
            seen = self._seen(request, scale, region, angles_rad)
            if scale.times > 1 and seen.pose is not None and self._too_small(seen.pose, scale):
                seen = self._seen(request, WHOLE, region, angles_rad)
        return seen if time_s is None else replace(seen, time_s=time_s)

    def _seen(
        self, request: Request, scale: Scale, region: Region | None,
        angles_rad: npt.ArrayLike | None,
    ) -> AppearanceObservation:  # fmt: skip
        """What is observed in a frame of some scale, or in a region of it."""
        finders, frame = self._seeing(scale), scale.shrunk(request.frame)
        if region is not None:
            region = region.shrunk(scale.times)
            frame = region.cut(frame)
            finders = tuple(finder.looking_at(region) for finder in finders)
        request = request._replace(frame=frame)
        if self.model.joints and self.search is not None:
            seen = self._of_configurations(finders, request, angles_rad)
        else:
            seen = finders[0].find(request)
        if region is not None:
            seen = region.in_frame(seen)
        if scale.times > 1:
            seen = with_outline(seen, lambda body: body.enlarged(scale.times))
        return seen

    def _looking_at(self, frame: Picture, pose: Pose) -> tuple[PoseFinder, Picture]:
        """What sees the target at a pose, and the frame in the size that ``recognize`` takes."""
        scale = self._scale(frame)
        if scale.times > 1 and self._too_small(pose, scale):
            scale = WHOLE
        return self._seeing(scale)[0], scale.shrunk(frame)

    def _too_small(self, pose: Pose, scale: Scale) -> bool:
        """Whether the target at a pose is too small in that scale to be told from others."""
        range_m = float(np.linalg.norm(pose.apply(self.model.centre_m)))
        return radius_px(self.camera, self.model.target_radius_m, range_m) < LEAST_PX * scale.times

    def _scale(self, frame: Picture) -> Scale:
        """In which size a frame is looked at: whole beside a picture of its background."""
        if self.search is None or self.outline.silhouette_options.background is not None:
            return WHOLE
        return Scale.of(frame)

    def _seeing(self, scale: Scale) -> tuple[PoseFinder, ...]:
        """What looks at frames in that size."""
        if scale not in self._seen_at:
            self._seen_at[scale] = tuple(finder.seeing(scale) for finder in self._finders)
        return self._seen_at[scale]

    def _of_configurations(
        self, finders: tuple[PoseFinder, ...], request: Request, angles_rad: npt.ArrayLike | None
    ) -> AppearanceObservation:
        """The observation of the configuration next to the angles, or the best of all."""
        searched, judged = finders, finders[0].judged
        models = [one.model for one in finders]

        def at(angles: Array) -> PoseFinder:
            return finders[models.index(self.model.configuration_at(angles))]

        if request.prior is not None and angles_rad is not None:
            angles = np.array(angles_rad, dtype=np.float64).reshape(len(self.model.joints))
            seen = _turned_to(at(angles), angles, request, tracked=True)
            if seen.found is None or seen.found.best.joint_support >= LEAST_SUPPORT:
                return seen
            # The parts are elsewhere, or hidden.
            others = around(self.model.joints, angles) + [model.angles_rad for model in models]
            again = [_turned_to(at(other), other, request) for other in others]
            return best_of([seen, *again], models, judged)
        observations: list[AppearanceObservation] = []
        if request.prior is None:
            searched, observations = _likely(searched, request)
        observations += [_turned_to(one, one.model.angles_rad, request) for one in searched]
        best = best_of(observations, models, judged)
        if best.found is None or best.found.best.angles_rad is None:
            return best
        # Edges of a part may have led to a local optimum of its angle.
        near = request._replace(prior=best.found.best.pose, prior_error_rad=NEAR_RAD)
        others = around(self.model.joints, best.found.best.angles_rad)
        again = [_turned_to(at(angles), angles, near) for angles in others]
        return best_of([*observations, *again], models, judged)

    def place_of(self, image: npt.ArrayLike, pose: Pose) -> Region | None:
        """Where to look in a frame for the target in any attitude at the place of a pose.

        ``None``: before a dark sky, where the target alone stands out, or outside the frame.
        """
        if Sky.of(check_frame(image, self.camera)).dark:
            return None
        return Region.at_place(self.model, self.camera, pose)

    def posterior(
        self, image: npt.ArrayLike, pose: Pose, sun_camera: npt.ArrayLike | None = None
    ) -> float:
        """Probability 0 … 1 of a pose among its look-alikes, wherever they are; 1 without any.

        Args:
            image: as for ``recognize``.
            pose: camera_from_target of the frame, refined.
            sun_camera: (3,) towards the Sun, camera frame, if it is known.
        """
        frame = check_frame(image, self.camera)
        if self.search is None or self.model.joints:
            return 1.0
        with self._lock:
            finder, frame = self._looking_at(frame, pose)
            search = finder.search
            assert search is not None
            return search.posterior(frame, Sky.of(frame, sun_camera), pose)

    def second_estimate(self, image: npt.ArrayLike, pose: Pose) -> Second | None:
        """The pose that the sketch of a frame shows, searched without a prior, beside another one.

        It takes a seventh of a second. ``None``: there is no sketch, or no pose on it.
        """
        if self.sketch is None:
            return None
        frame = check_frame(image, self.camera)
        with self._lock:
            finder, frame = self._looking_at(frame, pose)
            assert finder.sketch is not None
            choice = finder.sketch.anywhere(frame, Sky.of(frame))
        if choice is None:
            return None
        other = nearest_alike(choice.best.pose, pose, self.model.symmetries)
        return Second(other.angle_to(pose), choice.confidence)


def _likely(
    searched: tuple[PoseFinder, ...], request: Request
) -> tuple[tuple[PoseFinder, ...], list[AppearanceObservation]]:
    """The configurations that fit best after a brief search, and what the others observed."""
    frame, sky = request.frame, Sky.of(request.frame, request.sun_camera)
    traced = searched[0].outline.trace(frame, None, StageClock(), bright_sky=not sky.dark)
    merits, observations = [], []
    for one in searched:
        assert one.search is not None
        one.search.levels.start_at(one.model.angles_rad)
        found = None
        if traced.outlines is not None:
            found = one.search.anywhere(frame, sky, traced.outlines, brief=True)
        merits.append(-np.inf if found is None else found.merit)
        observations.append(AppearanceObservation(Status.LOST, found=found))
    order = np.argsort(-np.array(merits), kind="stable")
    chosen, others = order[:_CONFIGURATIONS], order[_CONFIGURATIONS:]
    return tuple(searched[k] for k in chosen), [observations[k] for k in others]


def _turned_to(
    finder: PoseFinder, angles_rad: Array, request: Request, *, tracked: bool = False
) -> AppearanceObservation:
    """The observation of a configuration, with the joints starting at some angles (J,)."""
    assert finder.search is not None
    finder.search.levels.start_at(angles_rad, tracked=tracked)
    return finder.find(request)
