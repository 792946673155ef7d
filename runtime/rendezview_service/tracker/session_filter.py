"""The filter of one session: fuses its camera's poses and other sensors' lines into one state.

The worker and replay run it beside the tracker, from the first frame. A session has a fused state
from the first measurement of another sensor on; before that, the filter only gives the rates of
the camera's motion, and does not influence the tracker.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.fusion import Fusion, FusionOptions, Measurement, Verdict
from rendezview.fusion.fusion import Estimate
from rendezview.fusion.log_lines import check_size
from rendezview.fusion.logs import kind_of
from rendezview.geometry.pose import Array, Pose
from rendezview.io.results import json_value
from rendezview.sensors.beam import BeamMesh
from rendezview.sensors.observation import Observation, Status
from rendezview_service.messages.fusion_messages import MOST_REMEMBERED, FusionRequest
from rendezview_service.messages.message_parts import CAMERA
from rendezview_service.tracker.sensor_lines import (
    Json,
    SensorLine,
    context_of,
    pose_of_fused,
    read_line,
    split_records,
)

# s; a time farther from the session's own is of another clock. Source: a chosen limit.
MOST_CLOCK_GAP_S = 60.0


@dataclass(slots=True)
class SensorCounts:
    """Counts of what one sensor has sent."""

    kind: str
    lines: int = 0
    silent: int = 0  # lines without a measurement
    heard: int = 0  # measurements
    accepted: int = 0
    reason: str | None = None  # if its last measurement was rejected


class SessionFilter:
    """Fuses the sensors of one session."""

    def __init__(
        self,
        request: FusionRequest | None = None,
        most_sensors: int | None = None,
        forgotten: bool = False,
        own: Sequence[str] = (),
        at_once: bool = False,
        mesh: BeamMesh | None = None,
    ) -> None:
        """A filter without measurements.

        Args:
            request: data on the sensors.
            most_sensors: beside the camera and its own; None: any number.
            forgotten: the session had a filter whose process ended; this one fuses at once.
            own: names of the sensors that the session reads itself.
            at_once: a fused state from the first frame on, not from another sensor's first line.
            mesh: the target's, that the beam of a ranger meets.
        """
        asked = request or FusionRequest()
        self._context = context_of(asked, mesh)
        options = asked.options or FusionOptions()
        most = min(options.history_most, MOST_REMEMBERED)
        self._options = replace(options, history_most=most)
        self._most_sensors = most_sensors
        self._counts: dict[str, SensorCounts] = {}
        self._note: str | None = None
        self._newest_s = -math.inf  # newest time that the filter has
        self.lines = 0  # so far, of all sensors
        self.measured_s = -math.inf  # of the newest measurement; -inf: none yet
        self._own = (CAMERA, *own)
        # Whether there is another sensor than the camera, so that the session has its state.
        self.fuses = forgotten or at_once
        self._start("its process ended" if forgotten else None)

    def resume(self, kept: Json) -> None:
        """Go on from the last `Fused` state of a process that ended."""
        self._start("its process ended")
        self.fuses = True
        pose = Pose.from_quat_wxyz(**kept["pose"])
        rates, status, covariance = None, Status(kept["status"]), np.array(kept["covariance"])
        if kept["rates"] is not None:
            rates = np.array([*kept["rates"]["angular_rad_s"], *kept["rates"]["linear_m_s"]])
        self._fusion.resume(Estimate(kept["time_s"], status, None, pose, rates, covariance))
        self._newest_s = kept["time_s"]

    @property
    def starts(self) -> tuple[int, str | None]:
        """How often it has started, and why it last restarted."""
        return self._fusion.starts, self._fusion.note

    # Lines of other sensors

    def check(
        self,
        sensor: str,
        text: bytes,
        frame_s: float,
        waited_s: float = 0.0,
        most_lines: int | None = None,
    ) -> list[SensorLine]:
        """Read the lines of a message without taking them.

        Args:
            text: JSON, one object or one per line.
            frame_s: time of the session's last frame; -inf: none yet.
            waited_s: since the session's previous input, by the service's own clock.

        Raises:
            RendezviewError: a line (named) is wrong or of another clock, or there are too many
                lines or sensors.
        """
        if sensor in self._own:
            raise RendezviewError(
                f"{sensor}: this session reads it in its frames: choose another name, or open the "
                f'session with "sensors": {{"{sensor}": …}} off'
            )
        records = split_records(text)
        if most_lines is not None and len(records) > most_lines:
            raise RendezviewError(
                f"{sensor}: {len(records)} lines: send at most {most_lines} at once"
            )
        known = self._counts.get(sensor)
        if known is None and self._most_sensors is not None:
            others = [name for name in self._counts if name not in self._own]
            if len(others) >= self._most_sensors:
                raise RendezviewError(
                    f"{sensor}: a session has at most {self._most_sensors} sensors beside its "
                    f"camera ({', '.join(others)}): use one of these names"
                )
        lines: list[SensorLine] = []
        for number, record in enumerate(records, start=1):
            where = f"{sensor}: line {number}"
            kind = kind_of(record, where)
            before = lines[0].kind if lines else known.kind if known else kind
            if kind != before:
                raise RendezviewError(
                    f"{where}: a line of a {kind} log, earlier ones were of a {before} log: give "
                    "each sensor a name of its own"
                )
            line = read_line(record, kind, sensor, self._context, where)
            if line.measurement is not None:
                self._check_clock(line.measurement, frame_s, waited_s, where)
            lines.append(line)
        return lines

    def take(self, sensor: str, line: SensorLine) -> tuple[Json | None, Json | None]:
        """Give a checked line to the filter: the `Verdict`, and the `Fused` state afterwards."""
        self.lines += 1
        self.fuses = self.fuses or line.measurement is not None
        verdict = self.add(sensor, line.kind, line.measurement)
        return verdict, self.state_at(self._newest_s) if self.fuses else None

    # The camera

    def track(self, observation: Observation) -> Json:
        """The `Fused` state at a frame, with the frame's pose."""
        time_s = observation.time_s
        assert time_s is not None
        apart_s = time_s - self._newest_s
        if math.isfinite(apart_s) and abs(apart_s) > MOST_CLOCK_GAP_S:
            jumped = f"the camera's time jumped by {apart_s:.0f} s"
            self._start(jumped if self._note is None else f"{self._note}; {jumped}")
        self._see(observation, time_s)
        return self.state_at(time_s)

    def expected(self, time_s: float) -> tuple[Pose, Array] | None:
        """camera_from_target at a time and its covariance (6, 6); None where it is not known."""
        return pose_of_fused(self.state_at(time_s)) if self.fuses else None

    def add(
        self, sensor: str, kind: str, measurement: Measurement | None, why: str | None = None
    ) -> Json | None:
        """Give a reading to the filter: the `Verdict`; None: nothing was measured, for a reason."""
        counts = self._counts.setdefault(sensor, SensorCounts(kind))
        counts.lines += 1
        try:
            if measurement is not None:
                check_size(measurement, sensor)
        except RendezviewError as error:
            measurement, why = None, str(error)
        if measurement is not None:
            return self._add(measurement, counts)
        counts.silent += 1
        counts.reason = why or counts.reason
        return None

    def health(self) -> dict[str, Json]:
        """Counts and trust of each sensor, by name: a `SensorTrust` and more."""
        trusts = self._fusion.trusts
        found = {}
        for name, counts in self._counts.items():
            trust = trusts.get(name)
            found[name] = asdict(counts) | {
                "locked_out": trust is not None and trust.locked,
                "lockouts": 0 if trust is None else trust.lockouts,
                "mean_nis": None if trust is None else _finite(trust.mean_nis),
            }
        return found

    def _start(self, note: str | None) -> None:
        self._fusion = Fusion(self._options)
        self._newest_s = self.measured_s = -math.inf
        self._note = note

    def _see(self, observation: Observation, time_s: float) -> None:
        """Give a frame's pose to the filter."""
        if observation.pose is not None and observation.covariance is not None:
            measurement, why = None, "the pose has an alarm of its integrity"
            try:
                measurement = observation.measurement(CAMERA)
            except ValueError as error:
                why = str(error)
            if self.add(CAMERA, "pose", measurement, why) is not None:
                return
        self._newest_s = max(self._newest_s, time_s)

    def _add(self, measurement: Measurement, counts: SensorCounts) -> Json:
        counts.heard += 1
        self.measured_s = max(self.measured_s, measurement.time_s)
        newest_s = max(self._newest_s, measurement.time_s)
        try:
            with np.errstate(all="ignore"):
                verdict = self._fusion.add(measurement)
                self._fusion.state_at(max(newest_s, self._fusion.time_s or newest_s))
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            # A filter cannot recover from a number that is not finite.
            note = f"the filter failed ({str(error)[:200]})"
            self._start(note)
            reason = f"{note} and was restarted"
            verdict = Verdict(measurement.sensor, measurement.time_s, False, reason)
        else:
            self._newest_s = newest_s
        counts.accepted += verdict.accepted
        counts.reason = None if verdict.accepted else verdict.reason
        return {
            "time_s": measurement.time_s,
            "accepted": verdict.accepted,
            "reason": verdict.reason,
            "nis": None if verdict.nis is None else _finite(verdict.nis),
            "degrees_of_freedom": verdict.size,
            "began": verdict.began,
        }

    def state_at(self, time_s: float) -> Json:
        """The `Fused` state at a time."""
        at_s = time_s if math.isfinite(time_s) else 0.0
        estimate = Estimate(at_s, Status.LOST, None, None, None, None)
        status, reason = "lost", None
        try:
            with np.errstate(all="ignore"):
                found = self._fusion.state_at(at_s)
            if found.covariance is not None and not np.isfinite(found.covariance).all():
                raise ArithmeticError("the covariance is not finite")
        except ValueError as error:
            status, reason = "late", str(error)
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            reason = str(error)
        else:
            estimate, status, reason = found, str(found.status), found.reason
        if status == "tracking":
            self._note = None
        elif self._note is not None:
            reason = f"the filter was restarted: {self._note}; {reason}"
        rates = None
        if estimate.rates is not None:
            both = estimate.rates.tolist()
            rates = {"angular_rad_s": both[:3], "linear_m_s": both[3:]}
        return {
            "time_s": at_s,
            "status": status,
            "reason": reason,
            "pose": None if estimate.pose is None else estimate.pose.as_dict(),
            "rates": rates,
            "covariance": _listed(estimate.covariance),
            "ring_radius": estimate.ring_radius,
            "ring_depth_m": estimate.ring_depth_m,
            "ring_covariance": _listed(estimate.ring_covariance),
            "protection": json_value(estimate.protection and estimate.protection.record()),
            "starts": self._fusion.starts,
            "note": estimate.note,
        }

    def _check_clock(
        self, measurement: Measurement, frame_s: float, waited_s: float, where: str
    ) -> None:
        now_s = max(self._newest_s, frame_s)
        apart_s = measurement.time_s - now_s
        if math.isfinite(now_s) and not -MOST_CLOCK_GAP_S <= apart_s <= MOST_CLOCK_GAP_S + waited_s:
            raise RendezviewError(
                f"{where}: time_s {measurement.time_s:g} is {abs(apart_s):.6g} s "
                f"{'after' if apart_s > 0.0 else 'before'} the session's own ({now_s:.6g}): "
                "all sensors of a session need one clock"
            )


def _listed(matrix: Array | None) -> Json | None:
    return None if matrix is None else matrix.tolist()


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
