"""The paper's method from a frame to a pose (Cleghorn & Sternberg 1991).

Silhouette → radial signature → trees → votes → placement. `OutlineRecognition.trace` takes the
first two steps, `OutlineRecognition.recognize` the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, pairwise

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.contour_at import target_box
from rendezview.sensors.appearance.edges.network import Sketch, Sketcher, around
from rendezview.sensors.appearance.model.signature import Outlines, Signature
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation, StageClock
from rendezview.sensors.appearance.outline.cut_out import CutOut
from rendezview.sensors.appearance.outline.interpolation import Interpolator
from rendezview.sensors.appearance.outline.placement import node_points, place
from rendezview.sensors.appearance.outline.reading import LateReading, OutlineReading
from rendezview.sensors.appearance.outline.silhouette import (
    Cleaning,
    Missing,
    Silhouette,
    SilhouetteOptions,
    find_silhouette,
    silhouette_of_mask,
)
from rendezview.sensors.appearance.outline.voted import VotedPose
from rendezview.sensors.appearance.outline.votes import Matcher, MatchOptions
from rendezview.sensors.appearance.region import Region
from rendezview.sensors.observation import Status

# Log odds of the forest about a pose that no refinement confirms.
# Source: experiment tree-ablation (0.1), seed 4101
_LEAST_VOTES = 0.0
# Px; before a bright sky, larger pictures are shrunk. Source: by construction, as fine as a sketch
_AREA_PX = 640 * 480


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """The silhouette of the target in a frame, or the reason for none."""

    silhouette: Silhouette | None
    outlines: Outlines | None  # of a silhouette that encloses an area
    missing: Missing | None = None
    sketch: Sketch | None = None  # before a bright sky


class OutlineRecognition:
    """Recognises the views of one model by their outlines, in the frames of one camera."""

    def __init__(
        self,
        model: ViewModel,
        camera: Camera,
        silhouette: SilhouetteOptions,
        match: MatchOptions | None = None,
    ) -> None:
        self.model = model
        self.camera = camera
        self.silhouette_options = silhouette
        self._options_of_means = replace(silhouette, averaged_px=1)
        self.matcher = Matcher(model, match)
        self._interpolator = None if model.views.far_change is None else Interpolator(model)
        self.sketcher = Sketcher()
        self._forest_scores = self.matcher.forest_scores
        self._voted = None if self._forest_scores is None else VotedPose(model, self._forest_scores)
        self._region: Region | None = None
        self._pixel_rad = 1.0 / float(np.sqrt(camera.fx * camera.fy))

    def with_camera(self, camera: Camera, region: Region | None) -> OutlineRecognition:
        """The same in the frames of another camera, or in the part of one where the target is."""
        other = copy(self)
        other.camera, other._region = camera, region
        other._pixel_rad = 1.0 / float(np.sqrt(camera.fx * camera.fy))
        return other

    def trace(
        self, frame: Picture, prior: Pose | None, clock: StageClock, *, bright_sky: bool
    ) -> Traced:
        """The silhouette and its signature.

        Args:
            frame: (H, W) of the camera's size.
            prior: camera_from_target; it chooses among several bodies.
            clock: counts the stages ``silhouette`` and ``signature``.
            bright_sky: whether a sketch shows the target.
        """
        body: Silhouette | Missing | None = None
        sketch: Sketch | None = None
        region = self._region
        if region is not None and region.mask is not None:
            body = silhouette_of_mask(region.mask)
        elif bright_sky:
            sketch, body = self._sketched(frame, prior)
        if body is None or isinstance(body, Missing):
            expected_px = None
            if region is not None and region.place_px is not None:
                expected_px = region.place_px - region.part[:2]
            if prior is not None:
                centre = prior.apply(self.model.centre_m)
                expected_px = self.camera.project(centre) if centre[2] > 0.0 else None
            body = find_silhouette(frame, self.silhouette_options, expected_px)
        clock.lap("silhouette")
        return replace(self._traced(body, clock), sketch=sketch)

    def _sketched(
        self, frame: Picture, prior: Pose | None
    ) -> tuple[Sketch | None, Silhouette | Missing | None]:
        """The sketch of a frame, and the body on it; None: it shows none.

        Without a prior, it is that of a finer one.
        """
        region = self._region
        if prior is not None:
            sketch = finer = self.sketcher.near(frame, target_box(self.model, self.camera, prior))
        else:
            box = None if region is None else region.box_in_part
            look = self.sketcher.look
            sketch = self.sketcher.find(frame) if box is None else look(frame, around(box))
            finer = None if sketch is None else self.sketcher.closer(frame, sketch)
        times = max(1, math.isqrt(frame.size // _AREA_PX))
        if finer is None:
            return sketch, None
        mask = np.where(finer.odds(frame.shape, times) > 0.0, 255, 0).astype(np.uint8)
        body = silhouette_of_mask(mask, self.silhouette_options)
        return sketch, body if isinstance(body, Missing) else body.enlarged(times)

    def seen(self, traced: Traced, pose: Pose, clock: StageClock) -> AppearanceObservation:
        """An outline in which the trees look at a pose when asked; see `read`."""
        return _late(lambda own: self.read(traced, pose, own), clock)

    def seen_from(
        self, frame: Picture, pose: Pose, clock: StageClock, *, bright_sky: bool
    ) -> AppearanceObservation:
        """The same, also traced when asked: about the pose, unless the sky is bright."""
        if bright_sky:
            return _late(
                lambda own: self.read(self.trace(frame, pose, own, bright_sky=True), pose, own),
                clock,
            )
        cut = self.cut_out(frame, pose)
        clock.lap("silhouette")
        return _late(lambda own: self.read(self.trace_in(cut, own), pose, own), clock)

    def cut_out(self, frame: Picture, pose: Pose) -> CutOut:
        """The part of a frame in which a target at a pose is traced."""
        options, centre_m = self.silhouette_options, pose.apply(self.model.centre_m)
        if options.background is not None or options.cleaning is not Cleaning.NONE:
            # They are in pixels of the frame.
            return CutOut.whole(frame, self.camera.project(centre_m))
        return CutOut.about(frame, self.camera, centre_m, self.model.target_radius_m)

    def trace_in(self, cut: CutOut, clock: StageClock) -> Traced:
        """The silhouette of the target in `cut_out` of a frame and a pose."""
        options = self._options_of_means if cut.times > 1 else self.silhouette_options
        found = find_silhouette(cut.picture, options, cut.centre_px)
        clock.lap("silhouette")
        return self._traced(found if isinstance(found, Missing) else cut.in_frame(found), clock)

    def _traced(self, body: Silhouette | Missing, clock: StageClock) -> Traced:
        if isinstance(body, Missing):
            return Traced(None, None, body)
        every = self.camera.rays(np.concatenate(body.outlines_px))
        ends = list(accumulate(map(len, body.outlines_px), initial=0))
        rays = [every[start:end] for start, end in pairwise(ends)]
        signature = Signature.of_outlines(rays, self.model.bins, self.model.smooth_bins)
        clock.lap("signature")
        return Traced(body, None if signature is None else Outlines(rays, signature))

    def read(self, traced: Traced, pose: Pose, clock: StageClock) -> OutlineReading:
        """Active nodes about a pose that needs no search, camera_from_target.

        They have points unless the outline is unlike the view that they agree on.
        """
        if traced.outlines is None:
            return OutlineReading(traced.silhouette)
        signature = traced.outlines.signature
        match = self.matcher.at(signature, pose)
        reading = OutlineReading(traced.silhouette, signature)
        if match is not None:
            points_m = np.zeros((0, 3))
            if self.matcher.refusal(match) is None:
                points_m = node_points(self.model, match, signature)
            reading = OutlineReading(
                traced.silhouette, signature, match.active_nodes, match.weights, points_m
            )
        clock.lap("trees")
        return reading

    def recognize(
        self,
        traced: Traced,
        prior: Pose | None,
        prior_error_rad: float | None,
        clock: StageClock,
        *,
        alone: bool = False,
    ) -> AppearanceObservation:
        """Active nodes of the silhouette, and the coarse pose they vote for.

        Args:
            traced: what `trace` has found.
            prior: camera_from_target; ``None``: all attitudes are searched.
            prior_error_rad: how far off the prior's attitude may be; ``None``: the default.
            clock: counts the stages ``trees`` and ``pose``.
            alone: no refinement follows, so a pose that the model's forest doubts is not given.
        """
        stage_ms = clock.stage_ms
        if traced.missing is not None:
            missing = traced.missing
            return AppearanceObservation(missing.status, missing.reason, stage_ms=stage_ms)

        def seen(
            status: Status, reason: str | None, outline: OutlineReading
        ) -> AppearanceObservation:
            return AppearanceObservation(status, reason, outline=outline, stage_ms=stage_ms)

        reading = OutlineReading(traced.silhouette)
        if traced.outlines is None:
            return seen(Status.SMALL, "the silhouette encloses no area", reading)
        signature = traced.outlines.signature
        reading = replace(reading, signature=signature)
        # A target off the boresight shows the side that its own line of sight meets.
        centred = None if prior is None else signature.centred_from_camera @ prior.rotation
        match = self.matcher.match(signature, centred, prior_error_rad)
        clock.lap("trees")
        refused = None
        if match is None:
            near = "" if prior is None else " near the prior attitude"
            reason = f"no node of the sphere recognises this view{near}"
            refused = Missing(Status.UNRECOGNIZED, reason)
        else:
            reading = replace(reading, active_nodes=match.active_nodes, weights=match.weights)
            refused = self.matcher.refusal(match)
            pose, covariance = place(self.model, match, signature)
            if refused is None and alone:
                refused = self._doubt(signature, pose)
        if refused is not None and alone:
            voted = self._by_votes(reading, prior, prior_error_rad)
            if voted is not None:
                return replace(voted, stage_ms=stage_ms)
        if refused is not None or match is None:
            assert refused is not None
            return seen(refused.status, refused.reason, reading)
        reading = replace(reading, points_m=node_points(self.model, match, signature))
        if self._interpolator is not None:
            interpolated = partial(self._interpolator.points, match, signature, self._pixel_rad)
            reading = replace(reading, interpolated=interpolated)
        clock.lap("pose")
        return replace(seen(Status.OK, None, reading), pose=pose, covariance=covariance)

    def _by_votes(
        self, reading: OutlineReading, prior: Pose | None, prior_error_rad: float | None
    ) -> AppearanceObservation | None:
        """The pose by votes on the signature of a reading, with its nodes; None without one."""
        signature, found = reading.signature, None
        error_rad = prior_error_rad or self.matcher.options.prior_error_rad
        if self._voted is not None and signature is not None:
            found = self._voted.find(signature, prior, error_rad)
        if found is None or signature is None:
            return None
        match = self.matcher.at(signature, found[0])
        if match is not None:
            points_m = node_points(self.model, match, signature)
            reading = replace(
                reading, active_nodes=match.active_nodes, weights=match.weights, points_m=points_m
            )
        return AppearanceObservation(Status.OK, pose=found[0], covariance=found[1], outline=reading)

    def _doubt(self, signature: Signature, pose: Pose) -> Missing | None:
        """Why the forest doubts a pose; None where they do not, or the model has none."""
        if self._forest_scores is None:
            return None
        votes = float(self._forest_scores.scores(signature, pose.rotation[None])[0])
        if votes >= _LEAST_VOTES:
            return None
        return Missing(
            Status.UNRECOGNIZED,
            f"the outline is not surely that of the view found (log odds {votes:.1f}, at least "
            f"{_LEAST_VOTES:g} is needed): shadow may hide a part of the target",
        )


def _late(read: Callable[[StageClock], OutlineReading], clock: StageClock) -> AppearanceObservation:
    """An observation whose outline is read when asked for, with the time that this takes."""
    reading = LateReading(lambda: read(StageClock(clock.stage_ms)))
    return AppearanceObservation(Status.OK, outline=reading, stage_ms=clock.stage_ms)
