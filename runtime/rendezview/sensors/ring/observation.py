"""The observation of the ring sensor: ellipses, and the circles that one of them can be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rendezview.geometry.pose import Pose
from rendezview.io.target import DockingRing
from rendezview.sensors.measurement import RingMeasurement, ring_candidates
from rendezview.sensors.observation import Observation
from rendezview.sensors.ring.choice import Choice
from rendezview.sensors.ring.circle_pose import CirclePose
from rendezview.sensors.ring.detector import RingEdge


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class RingObservation(Observation):
    """The ellipses of a frame, and the poses of the ring's circle.

    ``pose`` is always ``None``: a circle has no roll. Its five degrees of freedom are in `circle`.
    """

    edges: tuple[RingEdge, ...] = ()  # best first
    edge: int | None = None  # number of the edge that the circles are of
    circles: tuple[CirclePose, ...] = ()  # the poses that the edge allows, one or two
    choice: Choice | None = None  # which of the circles is the ring, and why
    # Other edges that may be the ring's, best first, and the poses that they allow; none of them
    # and none of `circles` is fused.
    rivals: tuple[tuple[int, tuple[CirclePose, ...]], ...] = ()
    doubtful: bool = False  # the edge may be no ring's at all; the same holds

    @property
    def is_open(self) -> bool:
        """Whether it is open which edge is the ring's."""
        return bool(self.rivals) or self.doubtful

    @property
    def circle(self) -> CirclePose | None:
        """The chosen circle; ``None`` where there is none or the choice is open."""
        if self.choice is None or self.choice.index is None:
            return None
        return self.circles[self.choice.index]

    def measurement(
        self, sensor: str, *, ring: DockingRing | None = None, mount: Pose | None = None
    ) -> RingMeasurement | None:
        """All circles with a covariance, for the filter to choose from; see `Observation`.

        None where it is open which edge is the ring's: a wrong one is a wrong range.
        """
        if self.is_open:
            return None
        circles = ((c.centre_m, c.axis, c.covariance) for c in self.circles)
        candidates = ring_candidates(circles)
        if not candidates:
            return None
        if ring is None:
            raise ValueError(f"{sensor}: a ring can be fused only with its place on the target")
        if self.time_s is None:
            raise ValueError(f"{sensor}: an observation without a time cannot be fused")
        taken = RingMeasurement(self.time_s, sensor, candidates, ring)
        return taken if mount is None else taken.in_camera(mount)

    def record(self) -> dict[str, Any]:
        """The observation as its line of JSON."""
        return {
            "time_s": self.time_s,
            "status": str(self.status),
            "reason": self.reason,
            "ellipses": [
                {
                    "centre_px": edge.ellipse.centre_px,
                    "semi_axes_px": edge.ellipse.semi_axes_px,
                    "angle_rad": edge.ellipse.angle_rad,
                    "covariance": edge.ellipse.covariance,
                    "systematic_px": edge.systematic_px,
                    "arc_deg": edge.arc_deg,
                    "score": edge.score,
                    "family": edge.group,
                    "contrast_grey": edge.contrast_grey,
                }
                for edge in self.edges
            ],
            "ellipse": self.edge,
            "poses": []
            if self.is_open
            else [
                _pose(circle)
                | {
                    "chosen": self.choice is not None and self.choice.index == k,
                    "reason": None if self.choice is None else self.choice.reason,
                }
                for k, circle in enumerate(self.circles)
            ],
            "candidates": [
                {"ellipse": edge, "poses": [_pose(circle) for circle in circles]}
                for edge, circles in ((self.edge, self.circles), *self.rivals)
            ]
            if self.is_open
            else [],
            "stage_ms": self.stage_ms,
        }


def _pose(circle: CirclePose) -> dict[str, Any]:
    return {
        "centre_m": circle.centre_m,
        "axis": circle.axis,
        "covariance": circle.covariance,
    }
