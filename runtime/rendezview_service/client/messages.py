"""Frames and states as they go over the wire, and the service's refusals."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.pose import Pose

Frame = npt.NDArray[np.uint8] | bytes  # (H, W) grey levels, or the bytes of a PNG or JPEG file
StateDict = dict[str, Any]


class ServiceError(RendezviewError):
    """The service refused a request; ``status`` is the HTTP status."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class ServiceTimeout(RendezviewError, TimeoutError):
    """No answer in time."""


def frame_content(frame: Frame) -> tuple[bytes | memoryview, str]:
    """The bytes to send, and their media type."""
    if isinstance(frame, bytes):
        kind = "image/png" if frame[:4] == b"\x89PNG" else "image/jpeg"
        return frame, kind
    image = np.asarray(frame)
    if image.dtype != np.uint8 or image.ndim != 2:
        raise RendezviewError(
            f"a frame must be (height, width) grey levels of 8 bit, not {image.shape} {image.dtype}"
        )
    return np.ascontiguousarray(image).reshape(-1).data, "application/octet-stream"


def frame_query(time_s: float | None, roi: npt.ArrayLike | None) -> str:
    """What is told of a frame beside its bytes, as the end of its address."""
    given = [] if time_s is None else [f"time_s={float(time_s)!r}"]
    if roi is not None:
        numbers: list[float] = np.asarray(roi, dtype=np.float64).tolist()
        given.append("roi=" + ",".join(map(repr, numbers)))
    return "?" + "&".join(given) if given else ""


def camera_message(camera: Camera) -> dict[str, Any]:
    """The camera as its `CameraMessage`; what the service takes for granted is left out."""
    given = {name: value for name, value in asdict(camera).items() if value is not None}
    del given["doubts"]  # of its file
    if camera.lens_model is LensModel.OPENCV:
        del given["lens_model"]
    return given


def pose_of_state(state: StateDict) -> Pose | None:
    """camera_from_target of a state; None without a pose."""
    pose = state["pose"]
    return None if pose is None else Pose.from_quat_wxyz(pose["quat_wxyz"], pose["translation_m"])


def fused_pose_of_state(state: StateDict) -> Pose | None:
    """camera_from_target by all sensors, from a state or the answer to sensor lines."""
    fused = state.get("fused")
    pose = None if fused is None else fused["pose"]
    return None if pose is None else Pose.from_quat_wxyz(pose["quat_wxyz"], pose["translation_m"])
