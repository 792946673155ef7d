"""What a session's own sensors and its filter say of a frame, as entities of Rerun.

Used by the live stream and by recordings. Below the entity of a session:

| entity | |
|---|---|
| ``fused`` | axes of the target at the filter's pose, camera frame |
| ``ring`` | centre and axis of each pose of the docking ring, camera frame; the chosen one green |
| ``target/path``, ``target/predicted`` | the fitted path of the camera and how it goes on |
| ``camera/image/ring``, ``camera/image/reflectors`` | ellipses and spots over the picture |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview_service.messages.message_parts import PoseMessage

_GREEN, _BLUE, _PURPLE = (80, 220, 120), (90, 160, 255), (200, 120, 255)
_TURNS = np.linspace(0.0, 2.0 * np.pi, 65)  # rad, along an ellipse. Source: chosen


def transform(rr: Any, pose: dict[str, Any] | None) -> Any:
    """camera_from_target of a record; without a pose, a scale of zero hides the last one."""
    if pose is None:
        return rr.Transform3D(scale=0.0)
    w, x, y, z = pose["quat_wxyz"]
    turn = rr.Quaternion(xyzw=[x, y, z, w])
    return rr.Transform3D(translation=pose["translation_m"], quaternion=turn)


def ring_arrows(rr: Any, poses: Sequence[dict[str, Any]]) -> Any:
    """Centre and axis of each pose of a docking ring; the chosen one is green."""
    return rr.Arrows3D(
        origins=[pose["centre_m"] for pose in poses],
        vectors=[pose["axis"] for pose in poses],
        colors=[_GREEN if pose.get("chosen") else _BLUE for pose in poses],
    )


class ReadingsRecorder:
    """Draws readings; what the next frame does not have disappears.

    Args:
        rr: the package rerun.
        log: of its stream.
        at: entity of the session, with a slash at its end; empty: the root.
        size_m: length of the axes.
    """

    def __init__(self, rr: Any, log: Any, at: str, size_m: float) -> None:
        self._rr, self._log, self._at, self._size_m = rr, log, at, size_m
        self._drawn: set[str] = set()

    def show(
        self,
        state: dict[str, Any],
        camera: Camera | None,
        scale: float = 1.0,
        more: dict[str, Any] | None = None,
    ) -> None:
        """Draw the readings of a `State`, or of any record with its keys.

        Args:
            camera: of the frame; None: nothing is drawn over the picture.
            scale: of the shown picture over the frame.
            more: other shapes, by entity.
        """
        shapes = self._in_space(state) | (more or {})
        if camera is not None:
            shapes |= self._in_picture(state, camera, scale)
        for name in self._drawn - shapes.keys():
            self._log(self._at + name, self._rr.Clear(recursive=False))
        for name, shape in shapes.items():
            self._log(self._at + name, shape)
        self._drawn = set(shapes)

    def _in_space(self, state: dict[str, Any]) -> dict[str, Any]:
        rr, shapes = self._rr, {}
        pose_message = (state.get("fused") or {}).get("pose")
        if pose_message is not None:
            fused = _pose(pose_message)
            shapes["fused"] = rr.Arrows3D(
                origins=[fused.translation_m] * 3,
                vectors=self._size_m * fused.rotation.T,
                colors=(255 * np.eye(3)).astype(np.uint8),
            )
        poses = (state.get("ring") or {}).get("poses") or ()
        if poses:
            shapes["ring"] = ring_arrows(rr, poses)
        path = state.get("trajectory") or {}
        segment = path.get("segment")
        if segment is not None:
            turn, centre = np.asarray(path["path_from_target"]), np.asarray(path["centre_m"])
            for name, key, colour in (
                ("path", "path_m", _GREEN),
                ("predicted", "predicted_m", _PURPLE),
            ):
                places = np.asarray(segment[key], dtype=np.float64).reshape(-1, 3) @ turn + centre
                shapes[f"target/{name}"] = rr.LineStrips3D([places], colors=colour)
        return shapes

    def _in_picture(self, state: dict[str, Any], camera: Camera, scale: float) -> dict[str, Any]:
        rr, shapes = self._rr, {}
        ring = state.get("ring") or {}
        candidates = [one["ellipse"] for one in ring.get("candidates") or ()]
        ellipses = candidates or ([ring["ellipse"]] if ring.get("ellipse") else [])
        if ellipses:
            lines = [scale * seen_ellipse(ellipse, camera) for ellipse in ellipses]
            shapes["camera/image/ring"] = rr.LineStrips2D(lines, colors=_GREEN)
        spots = (state.get("reflectors") or {}).get("spots") or ()
        if spots:
            places = [(scale * spot["x_px"], scale * spot["y_px"]) for spot in spots]
            shapes["camera/image/reflectors"] = rr.Points2D(places, colors=_GREEN, radii=4.0)
        return shapes


def _pose(pose_message: Any) -> Pose:
    try:
        return PoseMessage.model_validate(pose_message).pose
    except ValidationError as error:
        raise RendezviewError(f"fused: pose: {error.errors()[0]['msg']}") from None


def ellipse_points(ellipse: dict[str, Any]) -> Array:
    """Points (65, 2) px along an ellipse of a log."""
    a, b = ellipse["semi_axes_px"]
    c, s = math.cos(ellipse["angle_rad"]), math.sin(ellipse["angle_rad"])
    own = np.stack([a * np.cos(_TURNS), b * np.sin(_TURNS)], axis=1)
    return np.asarray(own @ np.array([[c, s], [-s, c]]) + np.asarray(ellipse["centre_px"]))


def seen_ellipse(ellipse: dict[str, Any], camera: Camera) -> Array:
    """Points (65, 2) px along an ellipse of the camera without its lens distortion, as seen."""
    points = ellipse_points(ellipse)
    return camera.project(camera.pinhole.rays(points)) if camera.is_distorted else points
