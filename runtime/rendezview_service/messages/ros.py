"""States as ROS messages: geometry_msgs, field for field."""

from __future__ import annotations

import math
from typing import Any

Json = dict[str, Any]

CAMERA_FRAME, TARGET_FRAME = "camera", "target"
# ROS has the translation first: ours is (rotation, translation), both about fixed axes.
_ORDER = (3, 4, 5, 0, 1, 2)  # Source: by construction


def pose_with_covariance_stamped(state: Json) -> Json | None:
    """geometry_msgs/PoseWithCovarianceStamped of a state: the target in the camera frame.

    None without a pose.
    """
    if state["pose"] is None or state["covariance"] is None:
        return None
    position, orientation = _place_and_turn(state)
    matrix = state["covariance"]
    covariance = [float(matrix[i][j]) for i in _ORDER for j in _ORDER]
    pose = {"position": position, "orientation": orientation}
    return {"header": _header(state), "pose": {"pose": pose, "covariance": covariance}}


def transform_stamped(state: Json) -> Json | None:
    """geometry_msgs/TransformStamped of a state: camera to target. None without a pose."""
    if state["pose"] is None:
        return None
    translation, rotation = _place_and_turn(state)
    return {
        "header": _header(state),
        "child_frame_id": TARGET_FRAME,
        "transform": {"translation": translation, "rotation": rotation},
    }


def _header(state: Json) -> Json:
    time_s = state["time_s"]
    sec = math.floor(time_s)
    nanosec = min(int((time_s - sec) * 1e9), 999_999_999)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": CAMERA_FRAME}


def _place_and_turn(state: Json) -> tuple[Json, Json]:
    pose = state["pose"]
    return _named("xyz", pose["translation_m"]), _named("wxyz", pose["quat_wxyz"])


def _named(names: str, values: list[float]) -> Json:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
