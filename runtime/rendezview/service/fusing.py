"""The filter of one session: its camera's poses and other sensors' lines, one state.

The worker runs it beside the tracker, which it does not influence, and so does replay. A session
whose camera is alone has none: it begins at the first line of another sensor that holds a
measurement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.fusion import Fusion, FusionOptions, Measurement, PoseMeasurement, Verdict
from rendezview.fusion.fusion import Estimate
from rendezview.fusion.logs import kind_of
from rendezview.geometry.pose import Pose
from rendezview.service.fusion_messages import MOST_REMEMBERED, FusionRequest
from rendezview.service.message_parts import MOST_TIME_S
from rendezview.service.sensor_lines import (
    Json,
    Line,
    check_size,
    context_of,
    read_line,
    split_records,
)

CAMERA = "camera"  # the name of the session's own
CLOCK_APART_S = 60.0  # times farther from the session's own are of another clock


@dataclass(slots=True)
class Heard:
    """What has come of one sensor."""

    kind: str
    lines: int = 0
    silent: int = 0  # lines without a measurement
    heard: int = 0
    accepted: int = 0
    reason: str | None = None  # why its last measurement was not accepted


class SessionFilter:
    """Several sensors of one session."""

    def __init__(
        self,
        request: FusionRequest | None = None,
        most_sensors: int | None = None,
        forgotten: bool = False,
    ) -> None:
        """A filter that has not begun.

        Args:
            request: what is known of the sensors.
            most_sensors: beside the camera; None: any number.
            forgotten: there was one before, whose process has ended: it begins at once.
        """
        asked = request or FusionRequest()
        self._context = context_of(asked)
        options = asked.options or FusionOptions()
        most = min(options.history_most, MOST_REMEMBERED)
        self._options = replace(options, history_most=most)
        self._most_sensors = most_sensors
        self._heard: dict[str, Heard] = {}
        self._note: str | None = None
        self._newest_s = -math.inf  # of what the filter has been given
        self._lines = 0
        self._fusion: Fusion | None = None
        if forgotten:
            self._begin("its process ended, and what it knew with it")

    @property
    def running(self) -> bool:
        """Whether a sensor beside the camera has measured something."""
        return self._fusion is not None

    @property
    def lines(self) -> int:
        """Taken so far, of all sensors."""
        return self._lines

    # Lines of other sensors

    def check(
        self,
        sensor: str,
        text: bytes,
        frame_s: float,
        waited_s: float = 0.0,
        most_lines: int | None = None,
    ) -> list[Line]:
        """The lines of a message, all of them right.

        Args:
            text: JSON, one object or one a line.
            frame_s: time of the session's last frame; -inf: none yet.
            waited_s: since something last came into the session, by the service's own clock.

        Raises:
            RendezviewError: one is wrong (named), of another clock, or there are too many
                sensors. Nothing is taken then.
        """
        records = split_records(text)
        if most_lines is not None and len(records) > most_lines:
            raise RendezviewError(f"{sensor}: {len(records)} lines: at most {most_lines} at once")
        known = self._heard.get(sensor)
        if known is None and self._most_sensors is not None:
            others = [name for name in self._heard if name != CAMERA]
            if len(others) >= self._most_sensors:
                raise RendezviewError(
                    f"{sensor}: a session takes {self._most_sensors} sensors beside its camera "
                    f"({', '.join(others)}): use one of these names"
                )
        lines: list[Line] = []
        for number, record in enumerate(records, start=1):
            where = f"{sensor}: line {number}"
            kind = kind_of(record, where)
            before = lines[0].kind if lines else known.kind if known else kind
            if kind != before:
                raise RendezviewError(
                    f"{where}: is of a {kind} log, those before were of a {before} log: give "
                    "each sensor a name of its own"
                )
            line = read_line(record, kind, sensor, self._context, where)
            if line.measurement is not None:
                self._check_clock(line.measurement, frame_s, waited_s, where)
            lines.append(line)
        return lines

    def take(self, sensor: str, line: Line) -> tuple[Json | None, Json | None]:
        """What became of a line that was checked, and the state at the newest time known."""
        heard = self._heard.setdefault(sensor, Heard(line.kind))
        heard.lines += 1
        self._lines += 1
        verdict = None
        if line.measurement is None:
            heard.silent += 1
        else:
            if self._fusion is None:
                self._begin(None)
            verdict = self._add(line.measurement, heard)
        return verdict, None if self._fusion is None else self._state(self._newest_s)

    # The camera

    def look(self, time_s: float, pose: Pose | None, covariance: npt.ArrayLike | None) -> Json:
        """The state at a frame, after the pose that it gave, if any. The filter must be running."""
        apart_s = time_s - self._newest_s
        if math.isfinite(apart_s) and abs(apart_s) > CLOCK_APART_S:
            self._begin(f"the camera's time went from what it was by {apart_s:.0f} s")
        if pose is None or covariance is None:
            self._newest_s = max(self._newest_s, time_s)
            return self._state(time_s)
        heard = self._heard.setdefault(CAMERA, Heard("pose"))
        heard.lines += 1
        try:
            measurement = PoseMeasurement(time_s, CAMERA, pose, np.asarray(covariance))
            check_size(measurement, CAMERA)
        except (ValueError, RendezviewError) as error:
            heard.silent += 1
            heard.reason = str(error)
            self._newest_s = max(self._newest_s, time_s)
        else:
            self._add(measurement, heard)
        return self._state(time_s)

    def health(self) -> dict[str, Json]:
        """How each sensor stands, by name."""
        trusts = {} if self._fusion is None else self._fusion.trusts
        found = {}
        for name, heard in self._heard.items():
            trust = trusts.get(name)
            found[name] = {
                "kind": heard.kind,
                "lines": heard.lines,
                "silent": heard.silent,
                "heard": heard.heard,
                "accepted": heard.accepted,
                "locked_out": trust is not None and trust.locked,
                "lockouts": 0 if trust is None else trust.lockouts,
                "mean_nis": None if trust is None else _finite(trust.mean_nis),
                "reason": heard.reason,
            }
        return found

    def _begin(self, note: str | None) -> None:
        self._fusion = Fusion(self._options)
        self._newest_s = -math.inf
        self._note = note

    def _add(self, measurement: Measurement, heard: Heard) -> Json:
        assert self._fusion is not None
        heard.heard += 1
        newest_s = max(self._newest_s, measurement.time_s)
        try:
            with np.errstate(all="ignore"):
                verdict = self._fusion.add(measurement)
                self._fusion.state_at(max(newest_s, self._fusion.time_s or newest_s))
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            # It has no way back from a number that is none.
            told = f"the filter could not go on ({str(error)[:200]})"
            self._begin(told)
            verdict = Verdict(measurement.sensor, measurement.time_s, False, f"{told}: begun anew")
        else:
            self._newest_s = newest_s
        heard.accepted += verdict.accepted
        heard.reason = None if verdict.accepted else verdict.reason
        return {
            "time_s": measurement.time_s,
            "accepted": verdict.accepted,
            "reason": verdict.reason,
            "nis": None if verdict.nis is None else _finite(verdict.nis),
            "degrees_of_freedom": verdict.size,
            "began": verdict.began,
        }

    def _state(self, time_s: float) -> Json:
        """The estimate at a time as a `Fused` message."""
        assert self._fusion is not None
        at_s = time_s if math.isfinite(time_s) else 0.0
        estimate: Estimate | None
        reason: str | None
        try:
            with np.errstate(all="ignore"):
                estimate = self._fusion.state_at(at_s)
            if estimate.covariance is not None and not np.isfinite(estimate.covariance).all():
                raise ArithmeticError("numbers beyond all measure")
        except ValueError as error:
            estimate, status, reason = None, "late", str(error)
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            estimate, status, reason = None, "lost", str(error)
        else:
            status, reason = str(estimate.status), estimate.reason
        if status == "tracking":
            self._note = None
        elif self._note is not None:
            reason = f"begun anew, {self._note}; {reason}"
        pose, rates, covariance = None, None, None
        if estimate is not None and estimate.pose is not None:
            pose = estimate.pose.as_dict()
        if estimate is not None and estimate.rates is not None:
            both = estimate.rates.tolist()
            rates = {"angular_rad_s": both[:3], "linear_m_s": both[3:]}
        if estimate is not None and estimate.covariance is not None:
            covariance = estimate.covariance.tolist()
        return {
            "time_s": at_s,
            "status": status,
            "reason": reason,
            "pose": pose,
            "rates": rates,
            "covariance": covariance,
            "ring_radius": None if estimate is None else estimate.ring_radius,
            "ring_depth_m": None if estimate is None else estimate.ring_depth_m,
            "starts": self._fusion.starts,
        }

    def _check_clock(
        self, measurement: Measurement, frame_s: float, waited_s: float, where: str
    ) -> None:
        if abs(measurement.time_s) > MOST_TIME_S:
            raise RendezviewError(f"{where}: time_s must be within ±{MOST_TIME_S:g}")
        now_s = max(self._newest_s, frame_s)
        apart_s = measurement.time_s - now_s
        if math.isfinite(now_s) and not -CLOCK_APART_S <= apart_s <= CLOCK_APART_S + waited_s:
            raise RendezviewError(
                f"{where}: time_s {measurement.time_s:g} is {abs(apart_s):.6g} s "
                f"{'after' if apart_s > 0.0 else 'before'} the session's own ({now_s:.6g}): "
                "sensors of a session need one clock"
            )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def warm_up() -> None:
    """Have the filter's loops compiled, or read from their cache: one of each kind of word."""
    ring = {"centre_m": [0.0, 0.0, 0.5], "axis": [0.0, 0.0, 1.0], "radius_m": 0.5}
    asked = {"ring": ring, "options": {"ring_radius_sigma": 1e-3}}
    filter_ = SessionFilter(FusionRequest.model_validate(asked))
    seen = {
        "centre_m": [0.0, 0.0, 10.5],
        "axis": [0.0, 0.0, 1.0],
        "covariance": (1e-4 * np.eye(5)).tolist(),
    }
    tilted = seen | {"axis": [0.0, 0.1, math.sqrt(0.99)]}
    pose = {"quat_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [0.0, 0.0, 10.0]}
    words: Sequence[tuple[str, Json]] = [
        ("pose", {"pose": pose, "covariance": (1e-4 * np.eye(6)).tolist()}),
        ("ring", {"ellipses": [], "poses": [seen, tilted]}),
        ("ring", {"ellipses": [], "poses": [seen]}),
        ("range", {"range_m": 10.5, "sigma_m": 0.02}),
    ]
    start = Pose.identity()
    start = Pose(start.rotation, np.array([0.0, 0.0, 10.0]))
    for k in range(3):
        for sensor, record in words:
            timed = record | {"time_s": float(k)}
            kind = kind_of(timed, sensor)
            filter_.take(sensor, read_line(timed, kind, sensor, filter_._context, sensor))
        filter_.look(k + 0.5, start, 1e-4 * np.eye(6))
    far = {"time_s": 2.9, "range_m": 30.0, "sigma_m": 0.02}
    filter_.take("range", read_line(far, "range", "range", filter_._context, "range"))
