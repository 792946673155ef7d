"""One frame in, one sighting out: status, on nodes, points in space, pose, covariance."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rendezview.appearance.match import Matcher, MatchOptions
from rendezview.appearance.model import ViewModel
from rendezview.appearance.placement import node_points, place
from rendezview.appearance.signature import Signature
from rendezview.appearance.silhouette import (
    Missing,
    Silhouette,
    SilhouetteOptions,
    check_frame,
    find_silhouette,
)
from rendezview.appearance.status import Status
from rendezview.camera import Camera
from rendezview.pose import Array, Pose, rotation_angle

# Beyond the residual that 99.5 % of good frames keep below, the outline is another one:
# of another body, or of the lit parts only.
_MOST_RESIDUAL = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What one frame showed. Without a pose there is a status and a reason."""

    status: Status
    reason: str | None = None
    pose: Pose | None = None  # camera_from_target
    covariance: Array | None = None  # (6, 6) rotation vector, translation; camera frame, left
    on_nodes: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    weights: Array = field(default_factory=lambda: np.zeros(0))  # (K,) trust in each on node
    points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))  # camera seen by each on node
    silhouette: Silhouette | None = None
    signature: Signature | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def score(self) -> float:
        """Agreement of the trees: the sum of the weights, about 3 for a good view."""
        return float(self.weights.sum())


class Recognizer:
    """Recognises the views of one model in the frames of one camera."""

    def __init__(
        self,
        model: ViewModel,
        camera: Camera,
        silhouette: SilhouetteOptions | None = None,
        match: MatchOptions | None = None,
    ) -> None:
        self.model = model
        self.camera = camera
        self.silhouette_options = silhouette or SilhouetteOptions()
        self.matcher = Matcher(model, match)

    def recognize(
        self,
        image: npt.ArrayLike,
        prior: Pose | None = None,
        prior_error_rad: float | None = None,
    ) -> Sighting:
        """Look at one frame.

        Args:
            image: (H, W) uint8 grey levels, of the camera's size.
            prior: camera_from_target, roughly; its range and bearing only serve to choose
                among several bodies. ``None``: all attitudes are searched, and a view that
                fits two of them gives ``AMBIGUOUS``.
            prior_error_rad: how far off the prior's attitude may be; default 20°.

        Raises:
            RendezviewError: the image is no 8-bit grey picture of the camera's size.
        """
        clock = _Clock()
        frame = check_frame(image, self.camera.width, self.camera.height)
        found = find_silhouette(frame, self.silhouette_options, self._expected_px(prior))
        clock.lap("silhouette")
        if isinstance(found, Missing):
            return Sighting(found.status, found.reason, stage_ms=clock.stages)
        outlines = [self.camera.rays(points) for points in found.outlines_px]
        signature = Signature.of_outlines(outlines, self.model.bins, self.model.smooth_bins)
        clock.lap("signature")
        seen = Sighting(Status.OK, silhouette=found, signature=signature, stage_ms=clock.stages)
        if signature is None:
            return replace(seen, status=Status.SMALL, reason="the silhouette encloses no area")
        match = self.matcher.match(signature, self._centred(prior, signature), prior_error_rad)
        clock.lap("trees")
        if match is None:
            near = "" if prior is None else " near the prior attitude"
            return replace(
                seen,
                status=Status.UNRECOGNIZED,
                reason=f"no node of the sphere recognises this view{near}",
            )
        seen = replace(seen, on_nodes=match.on_nodes, weights=match.weights)
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
        clock.lap("pose")
        return replace(seen, pose=pose, covariance=covariance, points_m=points_m)

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


class _Clock:
    """Milliseconds of each stage."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.stages[name] = 1e3 * (now - self._last)
        self._last = now
