"""Messages of a log: Foxglove's types, and the service's own states as JSON."""

from __future__ import annotations

import math
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from pydantic_core import to_json

from rendezview.geometry.camera import Camera, LensModel
from rendezview_service.messages.frames import Bytes, FrameKind, kind_of
from rendezview_service.messages.fusion_messages import LoggedMeasurement
from rendezview_service.messages.messages import State
from rendezview_service.messages.ros import CAMERA_FRAME, TARGET_FRAME
from rendezview_service.tracker.tracking import StateDict

# Channel, data, time (ns), sequence
Logged = tuple[int, bytes, int, int]
# Channels
STATE, POSE, TRANSFORM, CALIBRATION, RAW, COMPRESSED, MEASUREMENT, FUSED = range(1, 9)
TOPICS: dict[int, tuple[str, str, Any]] = {
    STATE: ("/rendezview/state", "rendezview.State", None),
    POSE: ("/target/pose", "foxglove.PoseInFrame", PoseInFrame),
    TRANSFORM: ("/tf", "foxglove.FrameTransform", FrameTransform),
    CALIBRATION: ("/camera/calibration", "foxglove.CameraCalibration", CameraCalibration),
    RAW: ("/camera/image", "foxglove.RawImage", RawImage),
    COMPRESSED: ("/camera/image/compressed", "foxglove.CompressedImage", CompressedImage),
    MEASUREMENT: ("/rendezview/measurement", "rendezview.Measurement", None),
    FUSED: ("/target/fused", "foxglove.PoseInFrame", PoseInFrame),
}


def json_schema(channel: int) -> dict[str, Any]:
    """JSON schema of the service's messages without references and alternatives, for viewers."""
    schema = (State if channel == STATE else LoggedMeasurement).model_json_schema()
    return _plain(schema, schema.get("$defs", {}))


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return _plain(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:  # X or null
        some = next(s for s in schema["anyOf"] if s.get("type") != "null")
        return _plain(some, definitions)
    named = ("type", "title", "description")
    plain: dict[str, Any] = {str(k): schema[k] for k in named if k in schema}
    if "properties" in schema:
        parts = schema["properties"].items()
        plain["properties"] = {name: _plain(part, definitions) for name, part in parts}
    if "items" in schema:
        plain["items"] = _plain(schema["items"], definitions)
    return plain


def _stamp(time_s: float) -> Timestamp:
    """Seconds as a protobuf timestamp."""
    whole = math.floor(time_s)
    return Timestamp(seconds=whole, nanos=min(int((time_s - whole) * 1e9), 999_999_999))


def _pose_in_frame(time_s: float, pose: dict[str, list[float]]) -> PoseInFrame:
    """foxglove.PoseInFrame: the target in the camera frame."""
    message = PoseInFrame(timestamp=_stamp(time_s), frame_id=CAMERA_FRAME)
    _set(message.pose.position, message.pose.orientation, pose)
    return message


def _frame_transform(time_s: float, pose: dict[str, list[float]]) -> FrameTransform:
    """foxglove.FrameTransform: the target in the camera frame."""
    at, parent, child = _stamp(time_s), CAMERA_FRAME, TARGET_FRAME
    message = FrameTransform(timestamp=at, parent_frame_id=parent, child_frame_id=child)
    _set(message.translation, message.rotation, pose)
    return message


def _calibration(time_s: float, camera: Camera) -> CameraCalibration:
    """foxglove.CameraCalibration."""
    matrix = camera.matrix
    fisheye = camera.lens_model is LensModel.FISHEYE
    distortion = list(camera.distortion) or [0.0] * 5
    if len(distortion) == 4 and not fisheye:
        distortion.append(0.0)
    polynomial = "plumb_bob" if len(distortion) == 5 else "rational_polynomial"
    projection = [*matrix[0], 0.0, *matrix[1], 0.0, *matrix[2], 0.0]
    return CameraCalibration(
        timestamp=_stamp(time_s),
        frame_id=CAMERA_FRAME,
        width=camera.width,
        height=camera.height,
        distortion_model="kannala_brandt" if fisheye else polynomial,
        D=distortion,
        K=matrix.ravel().tolist(),
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=projection,
    )


def _image(
    time_s: float, content: Bytes, kind: FrameKind, camera: Camera
) -> tuple[int, RawImage | CompressedImage]:
    """Channel and message of a frame, with its bytes as they arrived."""
    at, data = _stamp(time_s), bytes(content)
    if kind is not FrameKind.RAW:
        named = {"frame_id": CAMERA_FRAME, "format": str(kind)}
        return COMPRESSED, CompressedImage(timestamp=at, data=data, **named)
    raw = RawImage(
        timestamp=at,
        frame_id=CAMERA_FRAME,
        width=camera.width,
        height=camera.height,
        encoding="mono8",
        step=camera.width,
        data=data,
    )
    return RAW, raw


def of_frame(
    state: StateDict, state_json: bytes, content: Bytes | None, camera: Camera, calibrates: bool
) -> list[Logged]:
    """The messages of one frame; ``content``: its bytes as they arrived, if they are recorded."""
    time_s, pose, fused = state["time_s"], state["pose"], state.get("fused")
    parts: list[tuple[int, Any]] = []
    if pose is not None:
        parts.append((POSE, _pose_in_frame(time_s, pose)))
        parts.append((TRANSFORM, _frame_transform(time_s, pose)))
    if fused is not None and fused["pose"] is not None:
        parts.append((FUSED, _pose_in_frame(time_s, fused["pose"])))
    if content is not None:
        parts.append(_image(time_s, content, kind_of(content), camera))
    if calibrates:
        parts.append((CALIBRATION, _calibration(time_s, camera)))
    at = nanoseconds(time_s), state["frame"] & 0xFFFFFFFF
    packed = [(channel, message.SerializeToString(), *at) for channel, message in parts]
    return [(STATE, state_json, *at), *packed]


def of_measurements(lines: list[dict[str, Any]]) -> list[Logged]:
    """The messages of a sensor's lines, each a `LoggedMeasurement`."""
    parts: list[Logged] = []
    for line in lines:
        verdict, fused = line["verdict"], line["fused"]
        sequence = line["order"] & 0xFFFFFFFF
        at_s = line["received_unix_s"] if verdict is None else verdict["time_s"]
        text = to_json(line, inf_nan_mode="null")
        parts.append((MEASUREMENT, text, nanoseconds(at_s), sequence))
        if fused is not None and fused["pose"] is not None:
            pose = _pose_in_frame(fused["time_s"], fused["pose"]).SerializeToString()
            parts.append((FUSED, pose, nanoseconds(fused["time_s"]), sequence))
    return parts


def nanoseconds(time_s: float) -> int:
    """Seconds as a time of MCAP."""
    return max(0, int(time_s * 1e9))


def _set(place: Any, turn: Any, pose: dict[str, list[float]]) -> None:
    place.x, place.y, place.z = pose["translation_m"]
    turn.w, turn.x, turn.y, turn.z = pose["quat_wxyz"]
