"""One frame in, one observation out: status, on nodes, points in space, pose, covariance."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose, rotation_angle
from rendezview.io.grey_frame import check_frame
from rendezview.sensors.appearance.edges.confidence import Found
from rendezview.sensors.appearance.edges.refinement import Sky
from rendezview.sensors.appearance.edges.retrieval import Outlines
from rendezview.sensors.appearance.edges.search import PoseSearch
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.outline.bright_sky import find_bodies
from rendezview.sensors.appearance.outline.foreground import Foreground
from rendezview.sensors.appearance.outline.interpolation import Interpolator
from rendezview.sensors.appearance.outline.placement import node_points, place
from rendezview.sensors.appearance.outline.signature import Signature
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    Silhouette,
    SilhouetteOptions,
    find_silhouette,
)
from rendezview.sensors.appearance.outline.votes import Matcher, MatchOptions
from rendezview.sensors.observation import Status

_LEAST_MARGIN = 0.01  # of merits: nearer to each other, chance decides between two poses
_CLOSE_MARGIN = 0.1  # of merits: two poses that explain a frame as well

# Beyond the residual that 99.5 % of good frames keep below, the outline is another one:
# of another body, or of the lit parts only.
_MOST_RESIDUAL = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class AppearanceObservation:
    """What one frame showed. Without a pose there is a status and a reason."""

    status: Status
    reason: str | None = None
    pose: Pose | None = None  # camera_from_target
    covariance: Array | None = None  # (6, 6) rotation vector, translation; camera frame, left
    active_nodes: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    weights: Array = field(default_factory=lambda: np.zeros(0))  # (K,) trust in each on node
    points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))  # camera seen by each on node
    # Where views between the nodes see the camera (J, 3), and weights (J,): a millisecond, so it
    # waits until the cloud is asked for.
    between: Callable[[], tuple[Array, Array]] | None = None
    silhouette: Silhouette | None = None
    signature: Signature | None = None
    found: Found | None = None  # the best refined pose and its rival, given or not
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def confidence(self) -> float | None:
        """Probability that the refined pose is right, 0 … 1; None without refinement."""
        return None if self.found is None else self.found.confidence

    @property
    def cloud(self) -> tuple[Array, Array]:
        """Points (K, 3) m of the camera, target frame, and the trust in each (K,).

        Of the views between the nodes where the model can tell, else of the on nodes; none
        where there is no pose.
        """
        if self.between is not None and len(self.points_m):
            return self.between()
        return self.points_m, self.weights[: len(self.points_m)]

    @property
    def candidates(self) -> tuple[Pose, ...]:
        """Poses that fit but are not given: too little sure, or two that fit as well."""
        if self.found is None or self.status is Status.OK:
            return ()
        rival = self.found.rival
        close = rival is not None and self.found.margin < _CLOSE_MARGIN
        return (self.found.best.pose, *((rival.pose,) if rival and close else ()))

    @property
    def score(self) -> float:
        """The confidence of a refined pose; else the agreement of the trees, the sum of weights."""
        return float(self.weights.sum()) if self.confidence is None else self.confidence


class Recognizer:
    """Recognises the views of one model in the frames of one camera."""

    def __init__(
        self,
        model: ViewModel,
        camera: Camera,
        silhouette: SilhouetteOptions | None = None,
        match: MatchOptions | None = None,
        *,
        refine: bool = True,
        trees: bool = True,
        least_confidence: float = 0.6,
    ) -> None:
        """A recognizer of one model in the frames of one camera.

        Args:
            silhouette: what counts as the target.
            match: how the trees are asked.
            refine: move poses onto the edges of the frame, if the model has contour points.
            trees: ask for on nodes even where refinement from the prior is sure of itself;
                without, such frames take half the time.
            least_confidence: a refined pose less sure than this is not given.
        """
        self.model = model
        self.camera = camera
        self.silhouette_options = silhouette or SilhouetteOptions()
        self.matcher = Matcher(model, match)
        self.between = None if model.views.far_change is None else Interpolator(model)
        self.trees = trees
        self._foreground = Foreground()
        self.least_confidence = least_confidence
        self.search = PoseSearch(model, camera) if refine and model.contours is not None else None
        if silhouette is None and self.search is not None:
            # Shadow cuts a body in pieces; refinement tells whether they are the target's.
            self.silhouette_options = SilhouetteOptions(rival_fraction=2.0, merge_gap=0.6)

    def recognize(
        self,
        image: npt.ArrayLike,
        prior: Pose | None = None,
        prior_error_rad: float | None = None,
        sun_camera: npt.ArrayLike | None = None,
        enough_support: float = 1.0,
    ) -> AppearanceObservation:
        """Look at one frame.

        Args:
            image: (H, W) uint8 grey levels, of the camera's size.
            prior: camera_from_target, roughly; its range and bearing serve refinement as a
                starting point and choose among several bodies. ``None``: all attitudes are
                searched, and a view that fits two of them gives ``AMBIGUOUS``.
            prior_error_rad: how far off the prior's attitude may be; default 20°.
            sun_camera: (3,) towards the Sun, camera frame, if it is known.
            enough_support: with so much of its edges found, the pose next to the prior is taken
                and nothing else tried, if that is less than the finder's options ask for.

        Raises:
            ValueError: the direction to the Sun is none.
            RendezviewError: the image is no 8-bit grey picture of the camera's size.
        """
        clock = _Clock()
        frame = check_frame(image, self.camera.width, self.camera.height)
        if self.search is None:
            bodies = self._bodies(frame, None, prior)
            clock.lap("silhouette")
            if isinstance(bodies, Missing):
                return AppearanceObservation(bodies.status, bodies.reason, stage_ms=clock.stages)
            outlines = self._outlines(bodies)
            clock.lap("signature")
            return self._by_trees(bodies, outlines, prior, prior_error_rad, clock)
        sun = _unit(sun_camera)
        sky = Sky.of(frame, sun)
        found = None
        error = prior_error_rad or self.matcher.options.prior_error_rad
        if prior is not None:
            found = self.search.at(frame, sky, prior, error, enough_support)
            clock.lap("refine")
            if found is not None and not self.trees:
                return _observation(AppearanceObservation(Status.OK, stage_ms=clock.stages), found)
        bodies = self._bodies(frame, sky, prior)
        clock.lap("silhouette")
        outlines = []
        if not isinstance(bodies, Missing):
            outlines = self._outlines(bodies)
            clock.lap("signature")
        if prior is None and outlines:
            found = self.search.anywhere(frame, sky, outlines, sun)
            clock.lap("refine")
        sure = found if found is not None and self._trusted(found) else None
        if isinstance(bodies, Missing):
            seen = AppearanceObservation(bodies.status, bodies.reason, stage_ms=clock.stages)
        else:
            seen = self._by_trees(bodies, outlines, prior, prior_error_rad, clock, sure)
        if found is None and prior is not None:
            also = [] if seen.pose is None else [seen.pose]
            found = self.search.near(frame, sky, prior, error, outlines, also)
            clock.lap("refine")
        return self._judged(seen, found)

    def _trusted(self, found: Found) -> bool:
        """Whether a pose is given: it is likely right, and without a prior no other one is."""
        close = found.rival is not None and not found.prior and found.margin < _LEAST_MARGIN
        return found.confidence >= self.least_confidence and not close

    def _judged(self, seen: AppearanceObservation, found: Found | None) -> AppearanceObservation:
        """The observation with the refined pose, or with the reason why there is none."""
        nothing = replace(seen, pose=None, covariance=None, points_m=np.zeros((0, 3)))
        if found is None:
            if seen.status in (Status.OK, Status.AMBIGUOUS, Status.UNRECOGNIZED):
                return replace(
                    nothing,
                    status=Status.UNRECOGNIZED,
                    reason="no pose of the target fits the edges",
                )
            return nothing
        if self._trusted(found):
            return _observation(seen, found)
        if found.rival is not None and found.margin < _CLOSE_MARGIN:
            apart = found.best.pose.angle_to(found.rival.pose)
            return replace(
                nothing,
                status=Status.AMBIGUOUS,
                found=found,
                reason=f"two poses {np.rad2deg(apart):.0f}° apart fit this frame: "
                "give a prior, or look at more frames",
            )
        return replace(
            nothing,
            status=Status.LOST,
            found=found,
            reason=f"the best pose explains {100 * found.best.outline:.0f} % of its outline and "
            f"{100 * found.best.inner:.0f} % of its inner edges: too little to be sure",
        )

    def _bodies(
        self, frame: npt.NDArray[np.uint8], sky: Sky | None, prior: Pose | None
    ) -> list[Silhouette] | Missing:
        """The target's silhouette; several readings of it before a bright sky."""
        if sky is not None and not sky.dark:
            bodies = find_bodies(frame, self._foreground)
            if not isinstance(bodies, Missing):
                return bodies
        found = find_silhouette(frame, self.silhouette_options, self._expected_px(prior))
        return found if isinstance(found, Missing) else [found]

    def _outlines(self, bodies: list[Silhouette]) -> list[Outlines]:
        """Rays and signature of each silhouette that encloses anything."""
        outlines = []
        for body in bodies:
            rays = [self.camera.rays(points) for points in body.outlines_px]
            signature = Signature.of_outlines(rays, self.model.bins, self.model.smooth_bins)
            if signature is not None:
                outlines.append(Outlines(rays, signature))
        return outlines

    def _by_trees(
        self,
        bodies: list[Silhouette],
        outlines: list[Outlines],
        prior: Pose | None,
        prior_error_rad: float | None,
        clock: _Clock,
        sure: Found | None = None,
    ) -> AppearanceObservation:
        """On nodes of the first silhouette, and the coarse pose they mean.

        Where the pose is ``sure`` already, the trees are only asked at its attitude.
        """
        seen = AppearanceObservation(Status.OK, silhouette=bodies[0], stage_ms=clock.stages)
        if not outlines:
            return replace(seen, status=Status.SMALL, reason="the silhouette encloses no area")
        signature = outlines[0].signature
        seen = replace(seen, signature=signature)
        if sure is not None:
            match = self.matcher.at(signature, sure.best.pose)
        else:
            match = self.matcher.match(signature, self._centred(prior, signature), prior_error_rad)
        clock.lap("trees")
        if match is None:
            near = "" if prior is None else " near the prior attitude"
            return replace(
                seen,
                status=Status.UNRECOGNIZED,
                reason=f"no node of the sphere recognises this view{near}",
            )
        seen = replace(seen, active_nodes=match.active_nodes, weights=match.weights)
        limit = _MOST_RESIDUAL * self.model.held_out.residual
        if match.residual > limit:
            return replace(
                seen,
                status=Status.UNRECOGNIZED,
                reason=f"the outline is unlike every view of the target (differs by "
                f"{match.residual:.0f} thousandths of its size, at most {limit:.0f} is usual)",
            )
        if match.rival is not None:
            apart = rotation_angle(match.centred_from_target @ match.rival.centred_from_target.T)
            return replace(
                seen,
                status=Status.AMBIGUOUS,
                reason=f"two attitudes {np.rad2deg(apart):.0f}° apart fit this outline: "
                "give a prior, or look at more frames",
            )
        pose, covariance = place(self.model, match, signature)
        points_m = node_points(self.model, match, signature)
        between = None
        if self.between is not None and sure is None:  # a refined pose says it better
            pixel_rad = 1.0 / float(np.sqrt(self.camera.fx * self.camera.fy))
            between = partial(self.between.points, match, signature, pixel_rad)
        clock.lap("pose")
        return replace(seen, pose=pose, covariance=covariance, points_m=points_m, between=between)

    def _expected_px(self, prior: Pose | None) -> Array | None:
        if prior is None:
            return None
        centre = prior.apply(self.model.centre_m)
        return self.camera.project(centre) if centre[2] > 0.0 else None

    def _centred(self, prior: Pose | None, signature: Signature) -> Array | None:
        """Prior attitude of the camera turned to the centroid, by the pure rotation.

        The view direction is what the prior says of the target as seen along its own
        line of sight: a target off the boresight shows another side than its attitude
        relative to the camera's axes suggests.
        """
        if prior is None:
            return None
        return np.asarray(signature.centred_from_camera @ prior.rotation)


def _unit(direction: npt.ArrayLike | None) -> Array | None:
    if direction is None:
        return None
    vector = np.asarray(direction, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 0.0 < length < np.inf:
        raise ValueError(f"sun_camera must be three finite numbers, not all zero: {direction!r}")
    return np.asarray(vector / length)


def _observation(seen: AppearanceObservation, found: Found) -> AppearanceObservation:
    return replace(
        seen,
        status=Status.OK,
        reason=None,
        pose=found.best.pose,
        covariance=found.best.covariance,
        found=found,
    )


class _Clock:
    """Milliseconds of each stage, over all its turns."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.stages[name] = self.stages.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
