"""A pose in a frame with the evidence for it: what every search proposes, aligns and judges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rendezview.geometry.pose import Array, Pose


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A pose with its evidence; a source that has not been asked leaves its default."""

    pose: Pose  # camera_from_target
    # (6, 6) rotation vector, translation; camera frame, left. None: no edges were measured
    covariance: Array | None = None
    # Edges of the grey frame or of a sketch: share of the outline's points with an edge in place,
    # on a sketch the mean probability of an edge there
    outline: float = 0.0
    inner: float = 0.0  # the same of creases and steps
    visible: float = 0.0  # share of the outline that lies in the picture
    residual_px: float = float("nan")  # root mean square over the inliers
    light: float = 0.0  # share of the grey levels beside the edges that one light explains
    edge_variance_px2: float = 0.0  # σ² of an edge, with all inflation
    strain_covariance: Array | None = None  # (6, 6) the share of the mesh in the covariance
    angles_rad: Array | None = None  # (J,) of the joints; None: a rigid target
    joint_support: float = 1.0  # least share of a joint's visible points with an edge in place
    joint_covariance: Array | None = None  # (6 + J, 6 + J) as ``covariance``, then the angles
    points: int = 0  # of a near part: lit contour points in the picture
    # Of bright outlines beyond the predicted silhouette, see ``Retrieval.overshoot``
    overshoot: float = 0.0
    shading: float | None = None  # agreement of the surface with the frame, see ``Shading``
    sun_camera: Array | None = None  # (3,) unit, towards the Sun by shading or by drawing
    sketch: Array | None = None  # (7,) ``POSE_FEATURES`` on a sketch
    # Beside its rivals: cells of the frame that it leaves unexplained (inf: too small; NaN: no
    # rival), how far its picture differs from the likeliest's (0 … 1: enough that edges tell),
    # where a sketch leads it to, and its probability
    cost: float = float("nan")
    distinct: float = 1.0
    on_sketch: Hypothesis | None = None
    probability: float = 1.0

    @property
    def inlier_ratio(self) -> float:
        """0 … 1: two thirds the outline's, one third the inner edges'."""
        return inlier_ratio(self.outline, self.inner)


def inlier_ratio(outline: float, inner: float) -> float:
    """Of shares of the outline and of inner edges: two thirds the outline's."""
    return (2.0 * outline + inner) / 3.0


Bound = Callable[[Pose], bool]  # whether a pose may be the answer at all
# Where a sketch leads poses (N) to, with what agrees there; None: no hold.
Aligned = Callable[[Sequence[Pose]], list[Hypothesis | None]]
