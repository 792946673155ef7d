"""The paper's method from a frame to a pose (Cleghorn & Sternberg 1991).

Silhouette → radial signature → trees → votes → placement. `OutlineRecognition.trace` takes the
first two steps, `OutlineRecognition.recognize` the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation, StageClock
from rendezview.sensors.appearance.outline.bright_sky import find_bodies
from rendezview.sensors.appearance.outline.foreground import Foreground
from rendezview.sensors.appearance.outline.interpolation import Interpolator
from rendezview.sensors.appearance.outline.placement import node_points, place
from rendezview.sensors.appearance.outline.signature import Outlines, Signature
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    Silhouette,
    SilhouetteOptions,
    find_silhouette,
)
from rendezview.sensors.appearance.outline.voted import VotedPose
from rendezview.sensors.appearance.outline.votes import Matcher, MatchOptions
from rendezview.sensors.observation import Status

# Log odds of the voters about a pose that no refinement confirms.
# Source: experiment tree-ablation, seed 4101
_LEAST_VOTES = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """The silhouette of the target in a frame, or the reason for none."""

    silhouette: Silhouette | None  # the likeliest, if there are several
    outlines: list[Outlines]  # of each silhouette that encloses an area
    missing: Missing | None = None


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
        self.matcher = Matcher(model, match)
        self._interpolator = None if model.views.far_change is None else Interpolator(model)
        self._foreground = Foreground()
        self._ballot = self.matcher.ballot
        self._voted = None if self._ballot is None else VotedPose(model, self._ballot)
        self._pixel_rad = 1.0 / float(np.sqrt(camera.fx * camera.fy))

    def trace(
        self, frame: Picture, prior: Pose | None, clock: StageClock, *, bright_sky: bool
    ) -> Traced:
        """Silhouettes and their signatures; several silhouettes before a bright sky.

        Args:
            frame: (H, W) of the camera's size.
            prior: camera_from_target; it chooses among several bodies.
            clock: counts the stages ``silhouette`` and ``signature``.
            bright_sky: whether the network looks for the target first.
        """
        bodies = find_bodies(frame, self._foreground) if bright_sky else None
        if bodies is None or isinstance(bodies, Missing):
            expected_px = None
            if prior is not None:
                centre = prior.apply(self.model.centre_m)
                expected_px = self.camera.project(centre) if centre[2] > 0.0 else None
            found = find_silhouette(frame, self.silhouette_options, expected_px)
            bodies = found if isinstance(found, Missing) else [found]
        clock.lap("silhouette")
        if isinstance(bodies, Missing):
            return Traced(None, [], bodies)
        outlines = []
        for body in bodies:
            ends = np.cumsum([len(points) for points in body.outlines_px])[:-1]
            rays = np.split(self.camera.rays(np.concatenate(body.outlines_px)), ends)
            signature = Signature.of_outlines(rays, self.model.bins, self.model.smooth_bins)
            if signature is not None:
                outlines.append(Outlines(rays, signature))
        clock.lap("signature")
        return Traced(bodies[0], outlines)

    def recognize(
        self,
        traced: Traced,
        prior: Pose | None,
        prior_error_rad: float | None,
        confident: Pose | None,
        clock: StageClock,
        *,
        alone: bool = False,
    ) -> AppearanceObservation:
        """Active nodes of the likeliest silhouette, and the coarse pose they vote for.

        Args:
            traced: what `trace` has found.
            prior: camera_from_target; ``None``: all attitudes are searched.
            prior_error_rad: how far off the prior's attitude may be; ``None``: the default.
            confident: a refined pose that needs no search; the trees are only evaluated there.
            clock: counts the stages ``trees`` and ``pose``.
            alone: no refinement follows, so a pose that the model's voters doubt is not given.
        """
        if traced.missing is not None:
            missing = traced.missing
            return AppearanceObservation(missing.status, missing.reason, stage_ms=clock.stage_ms)
        partial_result = AppearanceObservation(
            Status.OK, silhouette=traced.silhouette, stage_ms=clock.stage_ms
        )
        if not traced.outlines:
            return replace(
                partial_result, status=Status.SMALL, reason="the silhouette encloses no area"
            )
        signature = traced.outlines[0].signature
        if confident is not None:
            match = self.matcher.at(signature, confident)
        else:
            # A target off the boresight shows the side that its own line of sight meets.
            centred = None if prior is None else signature.centred_from_camera @ prior.rotation
            match = self.matcher.match(signature, centred, prior_error_rad)
        clock.lap("trees")
        if match is None and alone:
            voted = self._by_votes(signature, prior, prior_error_rad)
            if voted is not None:
                return replace(partial_result, signature=signature, **voted)
        if match is None:
            near = "" if prior is None else " near the prior attitude"
            reason = f"no node of the sphere recognises this view{near}"
            return replace(
                partial_result, status=Status.UNRECOGNIZED, reason=reason, signature=signature
            )
        partial_result = replace(
            partial_result,
            signature=signature,
            active_nodes=match.active_nodes,
            weights=match.weights,
        )
        refused = self.matcher.refusal(match)
        pose, covariance = place(self.model, match, signature)
        if refused is None and alone:
            refused = self._doubt(signature, pose)
        if refused is not None and alone:
            voted = self._by_votes(signature, prior, prior_error_rad)
            if voted is not None:
                return replace(partial_result, **voted)
        if refused is not None:
            return replace(partial_result, status=refused.status, reason=refused.reason)
        points_m = node_points(self.model, match, signature)
        interpolated = None
        if self._interpolator is not None and confident is None:  # a refined pose is better
            interpolated = partial(self._interpolator.points, match, signature, self._pixel_rad)
        clock.lap("pose")
        return replace(
            partial_result,
            pose=pose,
            covariance=covariance,
            points_m=points_m,
            interpolated=interpolated,
        )

    def _by_votes(
        self, signature: Signature, prior: Pose | None, prior_error_rad: float | None
    ) -> dict[str, Any] | None:
        """What an observation has of the pose by votes; None without one."""
        error_rad = prior_error_rad or self.matcher.options.prior_error_rad
        found = None
        if self._voted is not None:
            found = self._voted.find(signature, prior, error_rad)
        if found is None:
            return None
        match = self.matcher.at(signature, found.pose)
        nodes: dict[str, Any] = {}
        if match is not None:
            points_m = node_points(self.model, match, signature)
            nodes = {"active_nodes": match.active_nodes, "weights": match.weights}
            nodes |= {"points_m": points_m}
        return nodes | {"pose": found.pose, "covariance": found.covariance}

    def _doubt(self, signature: Signature, pose: Pose) -> Missing | None:
        """Why the voters doubt a pose; None where they do not, or the model has none."""
        if self._ballot is None:
            return None
        votes = float(self._ballot.scores(signature, pose.rotation[None])[0])
        if votes >= _LEAST_VOTES:
            return None
        return Missing(
            Status.UNRECOGNIZED,
            f"the outline is not surely that of the view found (log odds {votes:.1f}, at least "
            f"{_LEAST_VOTES:g} is needed): shadow may hide a part of the target",
        )
