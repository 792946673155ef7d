"""Sensors' logs (JSON lines) as measurements, in order of time.

The keys of a log give its kind: ``range_m`` (a laser ranger), ``ellipses`` (`rendezview ring`),
``pose`` (`rendezview track`, `reflectors`, `stereo track`), ``rate_rad_s`` (a gyroscope),
``velocity_change_m_s`` (thrusters). A line without a measurement (no pose,
no echo) is no error: the sensor reported that it saw nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.fusion.fusion import Estimate, Fusion
from rendezview.fusion.log_lines import (
    LogLine,
    PoseLine,
    RangeLine,
    RateLine,
    RingLine,
    SurfaceKeys,
    ThrustLine,
    check_size,
)
from rendezview.fusion.options import FusionOptions
from rendezview.fusion.trust import Verdict
from rendezview.geometry.pose import Pose
from rendezview.io.files import StrPath, checked, read_json
from rendezview.io.pose_log import read_pose
from rendezview.io.results import json_line, read_json_lines
from rendezview.io.target import DockingRing
from rendezview.sensors.beam import BeamMesh, BeamSurface
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RateMeasurement,
    RingMeasurement,
    ThrustMeasurement,
    ring_candidates,
)

# σ of what a beam beside a ring meets, about its plane. Source: models_cad/client: 0.25 m in all of
# an approach; with 0.2 the place is 16 % worse at 60–45 m, with 0.5 it is 10 % better
_RELIEF_M = 0.5
_SERVED = "a session of the service: its `fusion`"


@dataclass(frozen=True, slots=True, eq=False)
class LogContext:
    """Data that the lines of a log lack."""

    ring: DockingRing | None = None  # for rings, and for ranges unless a surface is given
    surfaces: tuple[BeamSurface, ...] | BeamMesh = ()  # that a ranger's beam may meet
    mounts: Mapping[str, Pose] = field(default_factory=dict)  # sensor_from_camera by name


@dataclass(frozen=True, slots=True, eq=False)
class SensorLog:
    """The measurements of one file."""

    sensor: str
    kind: str  # pose, ring or range
    measurements: list[Measurement]
    silent: int  # lines without a measurement


def read_log(path: StrPath, sensor: str, context: LogContext) -> SensorLog:
    """The measurements of a sensor's log, each with its time and covariance.

    Raises:
        RendezviewError: missing, of no known kind, a line (named) is wrong or there twice, or what
            the kind needs (the target's ring, a surface) is not known.
    """
    records = read_json_lines(path)
    if not records:
        raise RendezviewError(f"{path}: holds no lines: name another log")
    kind = kind_of(records[0], str(path))
    _check_known(kind, str(path), context)
    measurements, first = list[Measurement](), dict[tuple[float, str], int]()
    for number, record in enumerate(records, start=1):
        where = f"{path}: record {number}"
        measurement = read_record(record, kind, sensor, context, where)
        if measurement is None:
            continue
        # Several beams and thrusters may act at once, not several of the target's poses.
        reading = measurement.time_s, json_line(record) if kind in ("range", "thrust") else ""
        if (other := first.setdefault(reading, number)) != number:
            raise RendezviewError(
                f"{where}: a second reading at time_s {measurement.time_s:g}, after record "
                f"{other}: give each line once, and each target its own log"
            )
        measurements.append(measurement)
    measurements.sort(key=lambda m: m.time_s)
    return SensorLog(sensor, kind, measurements, len(records) - len(measurements))


def kind_of(record: Mapping[str, Any], where: str) -> str:
    """The kind of measurement in a line, by its keys: ``range``, ``ring``, ``pose``, ….

    Raises:
        RendezviewError: of no known kind.
    """
    for key, (kind, *_) in _KINDS.items():
        if key in record:
            return kind
    raise RendezviewError(
        f"{where}: no log of a sensor that is known here: its lines have neither 'pose' (track, "
        "reflectors, stereo), nor 'ellipses' (ring), nor 'range_m' (a laser ranger), nor "
        "'rate_rad_s' (a gyroscope), nor 'velocity_change_m_s' (thrusters)"
    )


def read_record(
    record: Mapping[str, Any], kind: str, sensor: str, context: LogContext, where: str
) -> Measurement | None:
    """The measurement of one line, in the camera frame; None where the sensor saw nothing.

    Args:
        kind: of the log, by `kind_of`.
        where: place of the line, for error messages.

    Raises:
        RendezviewError: the line is wrong (its key is named), its numbers are too large or too
            small for the filter, or data that the kind needs are missing.
    """
    _check_known(kind, where, context)
    lines, reader = next((lines, reader) for k, lines, reader in _KINDS.values() if k == kind)
    line = checked(lines, record, f"{where}: no line of a {kind} log")
    wrong = f"{where}: no line of a {kind} log ("
    faults = (ValueError, ArithmeticError)
    with np.errstate(all="ignore"), explained(wrong, "): correct or remove it", faults):
        measurement: Measurement | None = reader(line, sensor, context)
        mount = context.mounts.get(sensor)
        if measurement is not None and mount is not None:
            measurement = measurement.in_camera(mount)
    if measurement is not None:
        check_size(measurement, where)
    return measurement


def merged(logs: list[SensorLog]) -> list[Measurement]:
    """All measurements in order of time; at one time in the order of the logs."""
    return sorted((m for log in logs for m in log.measurements), key=lambda m: m.time_s)


def read_options(path: StrPath) -> FusionOptions:
    """Options from a JSON file; its keys are those of `FusionOptions`, none is required.

    Raises:
        RendezviewError: missing, an unknown key, or a wrong value (named).
    """
    return checked(TypeAdapter(FusionOptions), read_json(path, "fusion options"), str(path))


def read_surfaces(path: StrPath) -> tuple[BeamSurface, ...]:
    """Surfaces that a beam can hit, from a JSON list; keys are those of `BeamSurface`.

    Raises:
        RendezviewError: missing, no list of such, or a wrong value.
    """
    lines = checked(_SURFACES, read_json(path, "surfaces"), f"{path}: no surfaces")
    with np.errstate(all="ignore"), explained(f"{path}: no surfaces: "):
        if not lines:
            raise ValueError("a list of surfaces is needed")
        return tuple(BeamSurface(**line.model_dump(exclude_none=True)) for line in lines)


def read_mount(path: StrPath) -> Pose:
    """``sensor_from_camera`` of a JSON file with ``quat_wxyz`` and ``translation_m``.

    Raises:
        RendezviewError: missing, or no pose.
    """
    return read_pose(path, "a sensor's place")


def _check_known(kind: str, where: str, context: LogContext) -> None:
    if kind == "range" and not context.surfaces and context.ring is None:
        raise RendezviewError(
            f"{where}: a range needs the surfaces it can hit: give --model, --surfaces, or "
            f"--target with a docking ring ({_SERVED})"
        )
    if kind == "ring" and context.ring is None:
        raise RendezviewError(
            f"{where}: a ring needs to know where it is on the target: give --target with a "
            f"docking ring ({_SERVED})"
        )


def _time(line: LogLine) -> Any:
    return line.time_s  # the measurement checks it


def _sigma(sigma: float | None, key: str) -> float:
    if sigma is None:
        raise ValueError(f"{key}: missing, add it")
    return sigma


def _pose_of(line: PoseLine, sensor: str, _: LogContext) -> Measurement | None:
    # A roll that may be half a turn off is no pose, and a pose with an alarm must not be used.
    if line.pose is None or line.covariance is None or line.roll_ambiguous:
        return None
    if line.protection is not None and line.protection.alarm:
        return None
    covariance, common = np.array(line.covariance), line.common_covariance
    shared = None if common is None else np.array(common)
    return PoseMeasurement(_time(line), sensor, line.pose.pose, covariance, shared)


def _ring_of(line: RingLine, sensor: str, context: LogContext) -> Measurement | None:
    assert context.ring is not None
    known = (c for c in line.poses if c.covariance is not None)
    candidates = ring_candidates(
        (c.centre_m, c.axis, np.array(c.covariance, dtype=np.float64)) for c in known
    )
    if not candidates:
        return None
    return RingMeasurement(_time(line), sensor, candidates, context.ring)


def _range_of(line: RangeLine, sensor: str, context: LogContext) -> Measurement | None:
    if line.range_m is None:
        return None
    surfaces = context.surfaces
    if not surfaces:
        assert context.ring is not None
        surfaces = (BeamSurface(context.ring.centre_m, context.ring.axis, _RELIEF_M),)
    return RangeMeasurement(
        _time(line), sensor, line.range_m, _sigma(line.sigma_m, "sigma_m"), surfaces,
        np.array(line.origin_m), np.array(line.direction),
    )  # fmt: skip


def _rate_of(line: RateLine, sensor: str, _: LogContext) -> Measurement | None:
    if line.rate_rad_s is None:
        return None
    sigma = _sigma(line.sigma_rad_s, "sigma_rad_s")
    return RateMeasurement(_time(line), sensor, np.array(line.rate_rad_s), sigma)


def _thrust_of(line: ThrustLine, sensor: str, _: LogContext) -> Measurement | None:
    if line.velocity_change_m_s is None:
        return None
    change, sigma = np.array(line.velocity_change_m_s), _sigma(line.sigma_m_s, "sigma_m_s")
    return ThrustMeasurement(_time(line), sensor, change, sigma)


# Kind, keys and reader by the key that identifies a log; the first match counts.
_KINDS: dict[str, tuple[str, TypeAdapter[Any], Callable[..., Measurement | None]]] = {
    "rate_rad_s": ("rate", TypeAdapter(RateLine), _rate_of),
    "velocity_change_m_s": ("thrust", TypeAdapter(ThrustLine), _thrust_of),
    "range_m": ("range", TypeAdapter(RangeLine), _range_of),
    "ellipses": ("ring", TypeAdapter(RingLine), _ring_of),
    "pose": ("pose", TypeAdapter(PoseLine), _pose_of),
}
_SURFACES = TypeAdapter(list[SurfaceKeys])


def sensor_name(text: str) -> tuple[str, Path]:
    """``NAME=PATH``, or a path that gives the name."""
    name, equals, path = text.partition("=")
    if equals and name and "/" not in name:
        return name, Path(path)
    return Path(text).stem, Path(text)


def state_record(estimate: Estimate, verdict: Verdict | None, fusion: Fusion) -> dict[str, Any]:
    """The state after a measurement, as its line of the log of ``fuse``."""
    pose = estimate.pose
    return {
        "time_s": estimate.time_s,
        "status": str(estimate.status),
        "reason": estimate.reason,
        "pose": pose,
        "rates": estimate.rates,
        "covariance": estimate.covariance,
        "ring_radius": estimate.ring_radius,
        "ring_depth_m": estimate.ring_depth_m,
        "ring_covariance": estimate.ring_covariance,
        "protection": None if estimate.protection is None else estimate.protection.record(),
        "starts": fusion.starts,
        "note": estimate.note,
        "measurement": None
        if verdict is None
        else {
            "sensor": verdict.sensor,
            "accepted": verdict.accepted,
            "reason": verdict.reason,
            "nis": verdict.nis,
            "degrees_of_freedom": verdict.size,
        },
        "sensors": {
            name: {
                "locked_out": trust.locked,
                "mean_nis": trust.mean_nis,
                "heard": trust.received,
                "accepted": trust.accepted,
                "lockouts": trust.lockouts,
            }
            for name, trust in fusion.trusts.items()
        },
    }
