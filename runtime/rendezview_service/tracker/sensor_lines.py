"""Lines of other sensors: read and checked, so that the filter of a session can use them.

The lines are those of `rendezview.fusion.logs`; this module adds limits, and data for the page.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError
from pydantic_core import from_json

from rendezview.errors import RendezviewError
from rendezview.fusion import Measurement
from rendezview.fusion.logs import LogContext, read_record
from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import describe
from rendezview.io.target import DockingRing
from rendezview.sensors.beam import BeamMesh, BeamSurface
from rendezview_service.messages.fusion_messages import (
    MOST_MARKS,
    FusionRequest,
    Marks,
    SurfaceMessage,
)

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class SensorLine:
    """One line of a sensor, checked."""

    kind: str
    record: Json
    measurement: Measurement | None
    marks: Json | None


def pose_of_fused(fused: Json) -> tuple[Pose, Array] | None:
    """The pose of a `Fused` state and its covariance (6, 6); None where the filter has none."""
    pose, covariance = fused["pose"], fused["covariance"]
    if pose is None or covariance is None:
        return None
    return Pose.from_quat_wxyz(**pose), np.array(covariance)[:6, :6]


def split_records(text: bytes) -> list[Json]:
    """The JSON objects of a message: one object, or one per line.

    Raises:
        RendezviewError: bad JSON, not an object, or an empty message.
    """
    try:
        whole = text.decode()
    except UnicodeDecodeError as error:
        raise RendezviewError(f"not UTF-8 ({error.reason}): send JSON") from None
    parts = [line for line in whole.split("\n") if line.strip()]
    if not parts:
        raise RendezviewError("the message is empty: send a line of a sensor's log")
    if parts[0].strip() == "{" or not parts[0].rstrip().endswith("}"):
        parts = [whole]  # one object over several lines
    records = []
    for number, part in enumerate(parts, start=1):
        try:
            record = from_json(part, allow_inf_nan=False)
        except ValueError as error:
            said = f"line {number}: not valid JSON ({error}): correct or remove it"
            raise RendezviewError(said) from None
        if not isinstance(record, dict):
            raise RendezviewError(f"line {number}: not a JSON object: send a sensor's log lines")
        records.append(record)
    return records


def read_line(record: Json, kind: str, sensor: str, context: LogContext, where: str) -> SensorLine:
    """Read one line of a sensor.

    Raises:
        RendezviewError: it cannot be read, or its numbers are too large or too small.
    """
    measurement = read_record(record, kind, sensor, context, where)
    return SensorLine(kind, record, measurement, _marks(sensor, record, context, where))


def _marks(sensor: str, record: Json, context: LogContext, where: str) -> Json | None:
    """Ellipses and spots to draw; none for a sensor with a mount, which has other pixels."""
    edges, spots = record.get("ellipses"), record.get("spots")
    if sensor in context.mounts or not (edges or spots):
        return None
    try:
        marks = {
            "sensor": sensor,
            "time_s": float(record["time_s"]),
            "ellipses": [
                {name: edge[name] for name in ("centre_px", "semi_axes_px", "angle_rad")}
                for edge in (edges or [])[:MOST_MARKS]
            ],
            "chosen": record.get("ellipse"),
            "spots_px": [[spot["x_px"], spot["y_px"]] for spot in (spots or [])[:MOST_MARKS]],
        }
        return Marks.model_validate(marks).model_dump()
    except ValidationError as error:
        raise RendezviewError(f"{where}: {describe(error)}") from None
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        said = f"no key {error}" if isinstance(error, KeyError) else str(error)[:200]
        raise RendezviewError(
            f"{where}: its ellipses or spots cannot be read ({said}): correct or remove them"
        ) from None


def context_of(asked: FusionRequest, mesh: BeamMesh | None = None) -> LogContext:
    """The data on the sensors that their logs are read with.

    Args:
        mesh: the target's, for the beam of a ranger where the request names no surfaces.
    """
    ring = None
    if asked.ring is not None:
        axis = np.array(asked.ring.axis)
        ring = DockingRing(
            np.array(asked.ring.centre_m),
            axis / np.linalg.norm(axis),
            asked.ring.radius_m,
            tuple(asked.ring.circles),
        )
    surfaces = tuple(map(_surface, asked.surfaces)) or mesh or ()
    return LogContext(ring, surfaces, {name: one.pose for name, one in asked.mounts.items()})


def _surface(message: SurfaceMessage) -> BeamSurface:
    outer_m = math.inf if message.outer_m is None else message.outer_m
    return BeamSurface(
        np.array(message.point_m),
        np.array(message.normal),
        message.relief_m,
        message.inner_m,
        outer_m,
    )
