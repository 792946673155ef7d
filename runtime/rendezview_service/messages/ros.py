"""States as ROS messages: geometry_msgs, field for field."""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from rendezview_service.messages.message_parts import Message

CAMERA_FRAME, TARGET_FRAME = "camera", "target"
# ROS has the translation first: ours is (rotation, translation), both about fixed axes.
_ORDER = (3, 4, 5, 0, 1, 2)  # Source: by construction


class Stamp(Message):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Message):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Xyz(Message):
    """geometry_msgs/Point and Vector3."""

    x: float
    y: float
    z: float


class Quaternion(Message):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class RosPose(Message):
    """geometry_msgs/Pose."""

    position: Xyz
    orientation: Quaternion


class RosPoseWithCovariance(Message):
    """geometry_msgs/PoseWithCovariance."""

    pose: RosPose
    covariance: list[float] = Field(
        min_length=36, max_length=36, description="row-wise; x, y, z, then rotation about x, y, z"
    )


class PoseWithCovarianceStamped(Message):
    """geometry_msgs/PoseWithCovarianceStamped: the target in the camera frame."""

    header: Header
    pose: RosPoseWithCovariance


class Transform(Message):
    """geometry_msgs/Transform."""

    translation: Xyz
    rotation: Quaternion


class TransformStamped(Message):
    """geometry_msgs/TransformStamped: camera to target."""

    header: Header
    child_frame_id: str
    transform: Transform


def pose_with_covariance_stamped(state: dict[str, Any]) -> PoseWithCovarianceStamped | None:
    """The pose of a state in JSON; None without one."""
    if state["pose"] is None or state["covariance"] is None:
        return None
    position, orientation = _place_and_turn(state)
    matrix = state["covariance"]
    covariance = [float(matrix[i][j]) for i in _ORDER for j in _ORDER]
    pose = RosPose(position=position, orientation=orientation)
    return PoseWithCovarianceStamped(
        header=_header(state), pose=RosPoseWithCovariance(pose=pose, covariance=covariance)
    )


def transform_stamped(state: dict[str, Any]) -> TransformStamped | None:
    """Camera to target, of a state in JSON; None without a pose."""
    if state["pose"] is None:
        return None
    translation, rotation = _place_and_turn(state)
    return TransformStamped(
        header=_header(state),
        child_frame_id=TARGET_FRAME,
        transform=Transform(translation=translation, rotation=rotation),
    )


def _header(state: dict[str, Any]) -> Header:
    time_s = state["time_s"]
    sec = math.floor(time_s)
    nanosec = min(int((time_s - sec) * 1e9), 999_999_999)
    return Header(stamp=Stamp(sec=sec, nanosec=nanosec), frame_id=CAMERA_FRAME)


def _place_and_turn(state: dict[str, Any]) -> tuple[Xyz, Quaternion]:
    x, y, z = state["pose"]["translation_m"]
    w, qx, qy, qz = state["pose"]["quat_wxyz"]
    return Xyz(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=w)
