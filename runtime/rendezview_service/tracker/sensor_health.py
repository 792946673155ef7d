"""Health of a session's sensors, as the service sees them."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from rendezview_service.messages.message_parts import CAMERA
from rendezview_service.messages.messages import SensorHealth, SensorTrust
from rendezview_service.messages.wire import Header

_RATE_OVER_S = 3.0  # s, over which a rate is averaged. Source: chosen
# s; a sensor without lines for longer is not healthy (some send rarely). Source: chosen.
_SILENT_S = 10.0
STALE_S = 3.0  # s; a camera without frames for longer is not healthy. Source: chosen
_SHOWN_S = 3.0  # s, for which its ellipses and spots are drawn. Source: chosen


@dataclass(slots=True)
class Arrivals:
    """Times of arrival, and their rate."""

    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=256))
    last_unix_s: float | None = None

    def add(self, now_s: float, unix_s: float) -> None:
        """Count an arrival."""
        self.times_s.append(now_s)
        self.last_unix_s = unix_s

    def rate_hz(self, now_s: float) -> float | None:
        """Rate over the last seconds; None with fewer than two arrivals."""
        recent = [at for at in self.times_s if now_s - at <= _RATE_OVER_S]
        if len(recent) < 2 or recent[-1] == recent[0]:
            return None
        return (len(recent) - 1) / (recent[-1] - recent[0])

    def silence(self, now_s: float, fault: str | None) -> str | None:
        """Why a camera is not healthy; None if it is.

        Args:
            fault: of its last frame.
        """
        if not self.times_s:
            return fault or "no frame yet"
        if now_s - self.times_s[-1] <= STALE_S:
            return fault
        silent = f"no frame for {now_s - self.times_s[-1]:.0f} s"
        return f"{silent}: {fault}" if fault else silent


class OtherSensors:
    """Health and marks of a session's other sensors; the worker sends the filter's opinion."""

    def __init__(self) -> None:
        self._by_filter: dict[str, dict[str, Any]] = {}  # `SessionFilter.health`
        self._arrivals: dict[str, Arrivals] = {}
        self._marks: dict[str, tuple[float, dict[str, Any]]] = {}
        self._lost_filter: str | None = None

    @property
    def is_fused(self) -> bool:
        """Whether the session has, or had, a filter."""
        return bool(self._arrivals)

    def received(self, sensor: str, now_s: float, unix_s: float, header: Header) -> None:
        """The worker has taken lines of a sensor."""
        self._arrivals.setdefault(sensor, Arrivals()).add(now_s, unix_s)
        if header["marks"] is not None:
            self._marks[sensor] = now_s, header["marks"]
        self.update(header)

    def tracked(self, now_s: float, unix_s: float, header: Header) -> None:
        """The worker has tracked a frame, and read the session's own sensors in it."""
        for sensor in header.get("own", ()):
            self._arrivals.setdefault(sensor, Arrivals()).add(now_s, unix_s)
        self.update(header)

    def update(self, header: Header) -> None:
        """Take the filter's opinion from a message of the worker, if it has one."""
        if "sensors" in header:
            self._by_filter = header["sensors"]

    def forget(self, reason: str) -> None:
        """The filter ended with its process."""
        self._by_filter = {}
        self._marks.clear()
        self._lost_filter = reason

    def marks(self, now_s: float) -> bytes:
        """The `Marks` of the last seconds, a JSON list."""
        recent = [marks for at, marks in self._marks.values() if now_s - at <= _SHOWN_S]
        return json.dumps(recent).encode() if recent else b"[]"

    def trust_of(self, sensor: str) -> SensorTrust | None:
        """The filter's opinion of a sensor."""
        known = self._by_filter.get(sensor)
        if known is None:
            return None
        return SensorTrust(**{name: known[name] for name in SensorTrust.model_fields})

    def health(
        self, now_s: float, frames: Arrivals, reason: str | None, tracked: int, drops: int
    ) -> list[SensorHealth]:
        """The camera, then the others in order of their first lines.

        Args:
            frames: arrivals of the camera's frames.
            reason: why the camera is not healthy; None if it is.
            tracked: number of tracked frames.
            drops: number of frames that newer ones replaced.
        """
        found = [
            SensorHealth(
                name=CAMERA,
                kind="camera",
                healthy=reason is None,
                reason=reason,
                frames=tracked,
                drops=drops,
                rate_hz=frames.rate_hz(now_s),
                last_unix_s=frames.last_unix_s,
                trust=self.trust_of(CAMERA),
            )
        ]
        for name, arrivals in self._arrivals.items():
            if name == CAMERA:
                continue
            known = self._by_filter.get(name, {"kind": "pose", "lines": 0})
            trust = self.trust_of(name)
            silent_s = now_s - arrivals.times_s[-1]
            reason = None
            if silent_s > _SILENT_S:
                reason = f"no line for {silent_s:.0f} s"
            elif trust is None:
                reason = self._lost_filter
            elif trust.locked_out:
                reason = f"locked out: {trust.reason}"
            found.append(
                SensorHealth(
                    name=name,
                    kind=known["kind"],
                    healthy=reason is None,
                    reason=reason,
                    frames=known["lines"],
                    drops=0,
                    rate_hz=arrivals.rate_hz(now_s),
                    last_unix_s=arrivals.last_unix_s,
                    trust=trust,
                )
            )
        return found
