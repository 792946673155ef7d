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
        self._by_filter = header["sensors"]

    def tracked(self, now_s: float, unix_s: float, header: Header) -> None:
        """The worker has tracked a frame, and read the session's own sensors in it."""
        for sensor in header.get("own", ()):
            self._arrivals.setdefault(sensor, Arrivals()).add(now_s, unix_s)
        self._by_filter = header.get("sensors", self._by_filter)

    def forget(self, reason: str) -> None:
        """The filter ended with its process."""
        self._by_filter = {}
        self._marks.clear()
        self._lost_filter = reason

    def marks(self, now_s: float) -> bytes:
        """The `Marks` of the last seconds, a JSON list."""
        recent = [marks for at, marks in self._marks.values() if now_s - at <= _SHOWN_S]
        return json.dumps(recent).encode() if recent else b"[]"

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
        found = [self._health(CAMERA, "camera", now_s, frames, tracked, drops, reason)]
        for name, arrivals in self._arrivals.items():
            known = self._by_filter.get(name)
            silent_s = now_s - arrivals.times_s[-1]
            why = None
            if silent_s > _SILENT_S:
                why = f"no line for {silent_s:.0f} s"
            elif known is None:
                why = self._lost_filter
            elif known["locked_out"]:
                why = f"locked out: {known['reason']}"
            kind, lines = ("pose", 0) if known is None else (known["kind"], known["lines"])
            found.append(self._health(name, kind, now_s, arrivals, lines, 0, why))
        return found

    def _health(
        self, name: str, kind: Any, now_s: float, arrivals: Arrivals, count: int, drops: int,
        reason: str | None,
    ) -> SensorHealth:  # fmt: skip
        """With the filter's opinion of the sensor."""
        known = self._by_filter.get(name)
        names = SensorTrust.model_fields
        return SensorHealth(
            name=name,
            kind=kind,
            healthy=reason is None,
            reason=reason,
            frames=count,
            drops=drops,
            rate_hz=arrivals.rate_hz(now_s),
            last_unix_s=arrivals.last_unix_s,
            trust=None if known is None else SensorTrust(**{n: known[n] for n in names}),
        )
