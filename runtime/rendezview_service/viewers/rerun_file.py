"""A run as a recording for the Rerun viewer (``.rrd``).

The root of the scene is the camera frame (x right, y down, z forward), as everywhere here:

| entity | |
|---|---|
| ``/camera`` | pinhole; its ``image`` the picture, ``image/contour``, ``image/ellipses``, … |
| ``/target`` | transform camera_from_target, absent where there is no pose; ``points``, ``axes`` |
| ``/truth`` | the same of the truth, where the scene has it |
| ``/ring`` | both axes of a docking ring |
| ``/fused``, ``/target/path``, … | what a service's own sensors and filter say |
| ``/status`` | status and reason, where they change |
| ``/plots/…`` | every number of the log, errors against the truth, σ of the pose |
"""

from __future__ import annotations

import contextlib
import math
import os
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.errors import optional
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.files import check_place, write_error
from rendezview.sensors.appearance import ViewModel
from rendezview_service.hub.rerun_readings import (
    ReadingsRecorder,
    ellipse_points,
    ring_arrows,
    transform,
)
from rendezview_service.tracker.model_geometry import geometry
from rendezview_service.tracker.tracking import contour_at
from rendezview_service.viewers.runs import Moment, pose_of

_ORANGE, _BLUE, _GREEN = (255, 140, 0), (90, 160, 255), (80, 220, 120)
# s; later times count from 1970, earlier ones from the start of the run. Source: chosen.
_UNIX_S = 1e8
_JPEG_QUALITY = 90  # 0 … 100. Source: chosen
_NO_NUMBERS = {"im_id", "time_s", "frame", "received_unix_s"}
_PICTURE = "camera/image"


def write_rerun(path: Path, run: Iterable[Moment], model: ViewModel | None = None) -> int:
    """Write a run as a Rerun recording, all or nothing; the number of its moments.

    Args:
        path: the file, ``.rrd``.
        run: see `rendezview_service.viewers.runs.moments`.
        model: of the target: its points, and its contour in the pictures.

    Raises:
        RendezviewError: rerun-sdk is not installed, the run has a fault, or the file cannot be
            written.
    """
    with optional("a Rerun recording needs", "rerun"):
        import rerun as rr
    check_place(path, "the recording")
    temporary = path.with_name(f".{path.name[:40]}.{secrets.token_hex(6)}.rrd")
    try:
        stream = rr.RecordingStream("rendezview")
        stream.save(temporary, default_blueprint=_blueprint())
        try:
            count = _Recorder(rr, stream, model).write(run)
        finally:
            stream.disconnect()  # flushes
        os.replace(temporary, path)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return count


class _Recorder:
    """Logs moments to one stream."""

    def __init__(self, rr: Any, stream: Any, model: ViewModel | None) -> None:
        self._rr, self._stream, self._model = rr, stream, model
        self._camera: Camera | None = None
        self._status: str | None = None
        self._size_m = 1.0 if model is None else 0.5 * model.target_radius_m
        self._readings = ReadingsRecorder(rr, stream.log, "", self._size_m)

    def write(self, run: Iterable[Moment]) -> int:
        rr, log = self._rr, self._stream.log
        log("/", rr.ViewCoordinates.RDF, static=True)
        if self._model is not None:
            points = geometry("", self._model)
            log(
                "target/points",
                rr.Points3D(points.points_m, colors=_ORANGE, radii=0.4 * points.spacing_m),
                static=True,
            )
        for entity in ("target", "truth"):
            log(f"{entity}/axes", self._axes(), static=True)
        count = 0
        for moment in run:
            self._write(moment)
            count += 1
        return count

    def _write(self, moment: Moment) -> None:
        rr, log, record = self._rr, self._stream.log, moment.record
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=moment.index)
        if moment.time_s is not None:
            unix = moment.time_s > _UNIX_S
            self._stream.set_time(
                "time", **{"timestamp" if unix else "duration": float(moment.time_s)}
            )
        where = f"frame {moment.index}"
        pose = pose_of(record, where)
        drawn = self._picture(moment, pose)
        log("target", transform(rr, None if pose is None else pose.as_dict()))
        if moment.camera is not None or moment.truth is not None:
            log("truth", transform(rr, None if moment.truth is None else moment.truth.as_dict()))
        for name, value in _numbers(record):
            log(f"plots/{name}", rr.Scalars(value))
        for name, value in _sigmas(record):
            log(f"plots/sigma/{name}", rr.Scalars(value))
        if pose is not None and moment.truth is not None:
            off_m = np.linalg.norm(pose.translation_m - moment.truth.translation_m)
            log("plots/error/rotation_deg", rr.Scalars(math.degrees(pose.angle_to(moment.truth))))
            log("plots/error/translation_m", rr.Scalars(float(off_m)))
        self._ring(record)
        self._readings.show(record, moment.camera, more=drawn)
        line = f"{record.get('status')}: {record['reason']}" if record.get("reason") else "ok"
        if line != self._status:
            self._status = line
            log("status", rr.TextLog(line, level="INFO" if line == "ok" else "WARN"))

    def _picture(self, moment: Moment, pose: Pose | None) -> dict[str, Any]:
        """Log the picture; the shapes over it, by entity."""
        rr, log, camera = self._rr, self._stream.log, moment.camera
        if camera is None:
            return {}
        if camera != self._camera:
            self._camera = camera
            size = [camera.width, camera.height]
            pinhole = rr.Pinhole(image_from_camera=camera.matrix, resolution=size)
            log(_PICTURE, pinhole)
        if moment.image is not None:
            picture = np.ascontiguousarray(moment.image)
            log(_PICTURE, rr.Image(picture, "L").compress(jpeg_quality=_JPEG_QUALITY))
        drawn: dict[str, Any] = {}
        contour = None
        if self._model is not None and pose is not None:
            contour = contour_at(self._model, camera, pose)
        if contour is not None:
            drawn[f"{_PICTURE}/contour"] = rr.Points2D(contour.points_px, colors=_BLUE, radii=1.0)
        spots = [(s["x_px"], s["y_px"]) for s in moment.record.get("spots") or () if "x_px" in s]
        if spots:
            drawn[f"{_PICTURE}/spots"] = rr.Points2D(spots, colors=_GREEN, radii=4.0)
        ellipses = [ellipse_points(e) for e in moment.record.get("ellipses") or ()]
        if ellipses:
            drawn[f"{_PICTURE}/ellipses"] = rr.LineStrips2D(ellipses, colors=_GREEN)
        return drawn

    def _ring(self, record: dict[str, Any]) -> None:
        if "ellipses" not in record:
            return
        self._stream.log("ring", ring_arrows(self._rr, record.get("poses") or ()))

    def _axes(self) -> Any:
        return self._rr.Arrows3D(
            vectors=self._size_m * np.eye(3), colors=(255 * np.eye(3)).astype(np.uint8)
        )


def _numbers(record: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Every number in a record and its mappings, with its path."""
    for name, value in record.items():
        if name in _NO_NUMBERS or name in ("pose", "segment"):
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
    yield "rotation_deg", math.degrees(math.sqrt(max(diagonal[:3].sum(), 0.0)))
    yield "translation_m", math.sqrt(max(diagonal[3:6].sum(), 0.0))


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial2DView(origin=f"/{_PICTURE}", name="picture"),
                rrb.TextLogView(origin="/status", name="status"),
                row_shares=[4, 1],
            ),
            rrb.Vertical(
                rrb.Spatial3DView(origin="/", name="space"),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="/plots/error", name="errors"),
                    rrb.TimeSeriesView(origin="/plots/sigma", name="σ"),
                    rrb.TimeSeriesView(origin="/plots", name="all numbers"),
                ),
                row_shares=[3, 2],
            ),
        ),
        collapse_panels=True,
    )
