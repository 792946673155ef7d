"""Frames with all that is known of them, as entities of Rerun: in a live stream, and in a file.

The root of a session is the camera frame (x right, y down, z forward), as everywhere here:

| entity | |
|---|---|
| ``camera`` | pinhole; its ``image`` the picture, ``image/contour``, ``image/ellipses``, … |
| ``camera/image/ring``, ``camera/image/reflectors`` | what a session's own sensors saw in it |
| ``target`` | transform camera_from_target, absent where there is no pose |
| ``target/path``, ``target/predicted`` | the fitted path of the camera and how it goes on |
| ``truth`` | as ``target``, where the scene has it |
| ``fused`` | axes of the target at the filter's pose, camera frame |
| ``ring`` | centre and axis of each pose of the docking ring, camera frame; the chosen one green |
| ``status`` | status and reason, where they change |
| ``plots/…`` | every number of the record, errors against the truth, σ of the pose |
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose

_GREEN, _BLUE, _PURPLE = (80, 220, 120), (90, 160, 255), (200, 120, 255)
_TURNS = np.linspace(0.0, 2.0 * np.pi, 65)  # rad, along an ellipse. Source: chosen
# s; later times count from 1970, earlier ones from the start of the run. Source: chosen.
_UNIX_S = 1e8
_NO_NUMBERS = {"im_id", "time_s", "frame", "received_unix_s", "pose", "segment"}
_PICTURE = "camera/image"


class RerunRecorder:
    """Draws the frames of one session; what the next frame does not have disappears."""

    def __init__(self, rr: Any, stream: Any, at: str, size_m: float) -> None:
        """Nothing is drawn yet.

        Args:
            rr: the package rerun.
            at: entity of the session, after a slash; empty: the root.
            size_m: length of axes.
        """
        self._rr, self._stream, self._at, self._size_m = rr, stream, at, size_m
        self._drawn: set[str] = set()
        self._pinhole: tuple[Camera, float] | None = None
        self._status: str | None = None
        stream.log(at or "/", rr.ViewCoordinates.RDF, static=True)

    def log(self, name: str, shape: Any, *, static: bool = False) -> None:
        """Log an entity below that of the session."""
        self._stream.log(f"{self._at}/{name}", shape, static=static)

    def axes(self, pose: Pose | None = None) -> Any:
        """The axes of a pose, or of the entity itself."""
        of = Pose.identity() if pose is None else pose
        return self._rr.Arrows3D(
            origins=[of.translation_m] * 3,
            vectors=self._size_m * of.rotation.T,
            colors=(255 * np.eye(3)).astype(np.uint8),
        )

    def show(
        self,
        index: int,
        time_s: float | None,
        record: dict[str, Any],
        pose: Pose | None,
        *,
        camera: Camera | None = None,
        picture: Any = None,
        scale: float = 1.0,
        contour_px: npt.ArrayLike = (),
        truth: Pose | None = None,
    ) -> None:
        """Draw a frame.

        Args:
            record: a `State`, or a line of a sensor's log.
            pose: of the record.
            camera: of the frame; None: nothing is drawn over the picture.
            picture: as Rerun has it; None: there is none.
            scale: of the picture over the frame.
            contour_px: (N, 2) at the pose, px of the frame.
            truth: camera_from_target, if it is known.
        """
        rr = self._rr
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=index)
        if time_s is not None:
            unix = time_s > _UNIX_S
            self._stream.set_time("time", **{"timestamp" if unix else "duration": float(time_s)})
        self.log("target", self._transform(pose))
        if camera is not None or truth is not None:
            self.log("truth", self._transform(truth))
        shapes = self._in_space(record)
        if camera is not None:
            self._project(camera, scale)
            shapes |= self._in_picture(record, camera, scale, contour_px)
        if picture is not None:
            self.log(_PICTURE, picture)
        for name in self._drawn - shapes.keys():
            self.log(name, rr.Clear(recursive=False))
        for name, shape in shapes.items():
            self.log(name, shape)
        self._drawn = set(shapes)
        for name, value in (*_numbers(record), *_sigmas(record), *_errors(pose, truth)):
            self.log(f"plots/{name}", rr.Scalars(value))
        line = f"{record.get('status')}: {record['reason']}" if record.get("reason") else "ok"
        if line != self._status:
            self._status = line
            self.log("status", rr.TextLog(line, level="INFO" if line == "ok" else "WARN"))

    def _transform(self, pose: Pose | None) -> Any:
        """camera_from_target; without a pose, a scale of zero hides the last one."""
        rr = self._rr
        if pose is None:
            return rr.Transform3D(scale=0.0)
        w, x, y, z = pose.as_dict()["quat_wxyz"]
        turn = rr.Quaternion(xyzw=[x, y, z, w])
        return rr.Transform3D(translation=pose.translation_m, quaternion=turn)

    def _project(self, camera: Camera, scale: float) -> None:
        """The camera of the pictures that follow."""
        if (camera, scale) != self._pinhole:
            self._pinhole = camera, scale
            size = [scale * camera.width, scale * camera.height]
            matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
            self.log(_PICTURE, self._rr.Pinhole(image_from_camera=matrix, resolution=size))

    def _in_space(self, record: dict[str, Any]) -> dict[str, Any]:
        rr, shapes = self._rr, {}
        fused = pose_of(record.get("fused") or {}, "fused")
        if fused is not None:
            shapes["fused"] = self.axes(fused)
        ring = record if "ellipses" in record else record.get("ring") or {}
        if poses := ring.get("poses"):
            shapes["ring"] = rr.Arrows3D(
                origins=[pose["centre_m"] for pose in poses],
                vectors=[pose["axis"] for pose in poses],
                colors=[_GREEN if pose.get("chosen") else _BLUE for pose in poses],
            )
        path = record.get("trajectory") or {}
        segment = path.get("segment")
        if segment is not None:
            turn, centre = np.asarray(path["path_from_target"]), np.asarray(path["centre_m"])
            for name, colour in (("path", _GREEN), ("predicted", _PURPLE)):
                flown = np.asarray(segment[f"{name}_m"], dtype=np.float64).reshape(-1, 3)
                strip = rr.LineStrips3D([flown @ turn + centre], colors=colour)
                shapes[f"target/{name}"] = strip
        return shapes

    def _in_picture(
        self, record: dict[str, Any], camera: Camera, scale: float, contour_px: npt.ArrayLike
    ) -> dict[str, Any]:
        rr, shapes = self._rr, {}
        contour = scale * np.reshape(contour_px, (-1, 2))
        if len(contour):
            shapes["contour"] = rr.Points2D(contour, colors=_BLUE, radii=1.0)
        ring = record.get("ring") or {}
        candidates = [one["ellipse"] for one in ring.get("candidates") or ()]
        undistorted = candidates or ([ring["ellipse"]] if ring.get("ellipse") else [])
        for name, lines in {
            "ring": [seen_ellipse(ellipse, camera) for ellipse in undistorted],
            "ellipses": [ellipse_points(ellipse) for ellipse in record.get("ellipses") or ()],
        }.items():
            if lines:
                scaled = [scale * line for line in lines]
                shapes[name] = rr.LineStrips2D(scaled, colors=_GREEN)
        for name, spots in {
            "reflectors": (record.get("reflectors") or {}).get("spots"),
            "spots": record.get("spots"),
        }.items():
            places = [(scale * s["x_px"], scale * s["y_px"]) for s in spots or () if "x_px" in s]
            if places:
                shapes[name] = rr.Points2D(places, colors=_GREEN, radii=4.0)
        return {f"{_PICTURE}/{name}": shape for name, shape in shapes.items()}


def pose_of(record: dict[str, Any], where: str) -> Pose | None:
    """The pose in a record, camera_from_target; None if it has none.

    Raises:
        RendezviewError: the value is no pose.
    """
    pose = record.get("pose")
    if pose is None:
        return None
    try:
        return Pose.from_quat_wxyz(pose["quat_wxyz"], pose["translation_m"])
    except (KeyError, TypeError, ValueError) as error:
        raise RendezviewError(f"{where}: pose: {error}: this is no log of a run") from error


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


def _numbers(record: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Every number in a record and its mappings, with its path."""
    for name, value in record.items():
        if name in _NO_NUMBERS:
            continue
        parts = value.items() if isinstance(value, dict) else [(None, value)]
        for part, number in parts:
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if math.isfinite(number):
                yield (name if part is None else f"{name}/{part}"), float(number)
    for listed in ("on_nodes", "candidates"):
        if isinstance(record.get(listed), list):
            yield listed, float(len(record[listed]))
    pose = record.get("pose")
    if isinstance(pose, dict):
        yield "distance_m", float(np.linalg.norm(pose["translation_m"]))


def _sigmas(record: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """σ of attitude and position over all axes, if the record has a pose's covariance."""
    covariance = record.get("covariance")
    if record.get("pose") is None or covariance is None or np.shape(covariance)[:1] < (6,):
        return
    diagonal = np.diag(np.asarray(covariance, dtype=np.float64))
    yield "sigma/rotation_deg", math.degrees(math.sqrt(max(diagonal[:3].sum(), 0.0)))
    yield "sigma/translation_m", math.sqrt(max(diagonal[3:6].sum(), 0.0))


def _errors(pose: Pose | None, truth: Pose | None) -> Iterator[tuple[str, float]]:
    """Errors of a pose, if the truth is known."""
    if pose is not None and truth is not None:
        yield "error/rotation_deg", math.degrees(pose.angle_to(truth))
        off_m = np.linalg.norm(pose.translation_m - truth.translation_m)
        yield "error/translation_m", float(off_m)
