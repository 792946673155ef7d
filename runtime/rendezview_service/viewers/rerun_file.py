"""A run as a recording for the Rerun viewer (``.rrd``); its entities: `RerunRecorder`."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.errors import optional
from rendezview.io.files import check_place, write_error
from rendezview.sensors.appearance import ViewModel
from rendezview_service.hub.rerun_recorder import RerunRecorder, pose_of
from rendezview_service.tracker.model_geometry import geometry
from rendezview_service.tracker.tracking import contour_at
from rendezview_service.viewers.runs import Moment

_ORANGE = (255, 140, 0)  # of points. Source: chosen
_JPEG_QUALITY = 90  # 0 … 100. Source: chosen


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
            count = _write(rr, stream, run, model)
        finally:
            stream.disconnect()  # flushes
        os.replace(temporary, path)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return count


def _write(rr: Any, stream: Any, run: Iterable[Moment], model: ViewModel | None) -> int:
    recorder = RerunRecorder(rr, stream, "", 1.0 if model is None else 0.5 * model.target_radius_m)
    if model is not None:
        known = geometry("", model)
        points = rr.Points3D(known.points_m, colors=_ORANGE, radii=0.4 * known.spacing_m)
        recorder.log("target/points", points, static=True)
    for entity in ("target", "truth"):
        recorder.log(f"{entity}/axes", recorder.axes(), static=True)
    count = 0
    for count, moment in enumerate(run, start=1):  # noqa: B007
        pose, camera = pose_of(moment.record, f"frame {moment.index}"), moment.camera
        picture = contour = None
        if camera is not None and moment.image is not None:
            levels = np.ascontiguousarray(moment.image)
            picture = rr.Image(levels, "L").compress(jpeg_quality=_JPEG_QUALITY)
        if camera is not None and model is not None and pose is not None:
            contour = contour_at(model, camera, pose)
        recorder.show(
            moment.index,
            moment.time_s,
            moment.record,
            pose,
            camera=camera,
            picture=picture,
            contour_px=() if contour is None else contour.points_px,
            truth=moment.truth,
        )
    return count


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial2DView(origin="/camera/image", name="picture"),
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
