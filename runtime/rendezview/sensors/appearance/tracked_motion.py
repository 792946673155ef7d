"""What a tracker knows of its target: the last pose, its rates and its probability."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rendezview.estimation.motion import extrapolate, rates_between
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.model.view_model import ViewModel

# target radii; a centre predicted nearer than this is not used. Source: by construction, inside the
# target
_NEAREST_RADII = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class TrackedMotion:
    """The last pose and the rates between the last two."""

    pose: Pose  # camera_from_target
    posterior: float = 1.0  # of the poses among their look-alikes, by the frames until here …
    weighed: Pose | None = None  # … the last of which showed this pose
    time_s: float | None = None  # None: of a pose that no frame has shown yet
    turn_rad_s: Array = field(default_factory=lambda: np.zeros(3))  # (3,) camera frame
    move_m_s: Array = field(default_factory=lambda: np.zeros(3))  # (3,) of the view centre, same

    @classmethod
    def followed(
        cls,
        last: TrackedMotion | None,
        pose: Pose,
        time_s: float,
        found: Found | None,
        centre_m: Array,
    ) -> TrackedMotion:
        """The motion after the next pose, (3,) ``centre_m`` of the view centre, target frame."""
        beside = searched(found, pose, last)
        if last is None or last.time_s is None or time_s <= last.time_s:
            return cls(pose, *beside, time_s)
        rates = rates_between(last.pose, pose, time_s - last.time_s, centre_m)
        return cls(pose, *beside, time_s, rates[:3], rates[3:])

    @property
    def moves(self) -> bool:
        """Whether there are rates."""
        return bool(self.turn_rad_s.any() or self.move_m_s.any())

    def at(self, time_s: float, longest_s: float, model: ViewModel) -> Pose:
        """camera_from_target at a later time; after ``longest_s`` the target rests."""
        if self.time_s is None or not self.moves:
            return self.pose
        ahead_s = min(time_s - self.time_s, longest_s)
        rates = np.concatenate([self.turn_rad_s, self.move_m_s])
        pose = extrapolate(self.pose, rates, ahead_s, model.centre_m)
        near = pose.apply(model.centre_m)[2] < _NEAREST_RADII * model.target_radius_m
        return self.pose if near else pose


def searched(
    found: Found | None, pose: Pose, last: TrackedMotion | None = None
) -> tuple[float, Pose | None]:
    """Posterior and weighed pose: of a search, or near a prediction those of the motion before."""
    if found is not None and not found.prior:
        return found.posterior, pose
    return (1.0, None) if last is None else (last.posterior, last.weighed)
