"""The path of one session: the follower of `rendezview guide`, fed by the session's frames."""

from __future__ import annotations

import math

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.io.results import json_value
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.trajectory import FollowerOptions, PathFollower, plan_of
from rendezview.trajectory.follower import record
from rendezview_service.messages.frame_sensor_messages import TrajectoryRequest
from rendezview_service.tracker.sensor_lines import Json, pose_of_fused

# A frame is fitted that is later than the last one by this share of the segment so far: of frames
# that come fast, some hundreds are. Source: experiment trajectory-accuracy, 100 frames a segment
_STEP = 0.01


class SessionPath:
    """Fits the path that the camera flies about the target."""

    def __init__(self, request: TrajectoryRequest, centre_m: Array) -> None:
        """A follower without frames.

        Args:
            request: with a shape or a plan.
            centre_m: (3,) of the path, target frame, where neither request nor plan has one.

        Raises:
            RendezviewError: the plan is none.
        """
        plan = None if request.plan is None else plan_of(request.plan, "trajectory: plan")
        given = centre_m if request.centre_m is None else np.array(request.centre_m)
        options = FollowerOptions()
        if plan is not None:
            options = FollowerOptions(turn_rad=plan.turn_rad, segment_s=plan.segment_s)
        self._follower = PathFollower(given, request.shape, plan, options)
        self._last_s = -math.inf
        self._record: Json | None = None

    def update(
        self, time_s: float, fused: Json | None, observation: AppearanceObservation
    ) -> Json | None:
        """The `Trajectory` at a frame: a new one, or the last while frames come fast.

        Args:
            time_s: of the frame.
            fused: the filter's state; None: no filter runs, the tracker's pose is the frame's.
            observation: of the tracker.
        """
        flown = self._follower.cloud.times_s
        if len(flown) and time_s - self._last_s < _STEP * (time_s - flown[0]):
            return self._record
        self._last_s = time_s
        if fused is None:
            report = self._follower.update(
                time_s, observation.pose, observation.covariance, *observation.cloud
            )
        else:
            report = self._follower.update(time_s, *(pose_of_fused(fused) or (None, None)))
        self._record = {
            "time_s": time_s,
            **json_value(record(report)),
            "centre_m": self._follower.centre_m.tolist(),
            "path_from_target": report.path_from_target.tolist(),
        }
        return self._record
