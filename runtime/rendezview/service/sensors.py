"""What is known of a session's sensors besides its camera, as the service sees them."""

from __future__ import annotations

import json
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from rendezview.service.fusing import CAMERA
from rendezview.service.messages import SensorHealth, SensorTrust
from rendezview.service.wire import Header

_RATE_OVER_S = 3.0
_SILENT_S = 10.0  # a sensor without lines that long is not healthy: some speak seldom
_SHOWN_S = 3.0  # what it saw in the picture is drawn so long


@dataclass(slots=True)
class Arrivals:
    """When something came, for its rate."""

    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=256))
    last_unix_s: float | None = None

    def add(self, now_s: float, unix_s: float) -> None:
        """Another."""
        self.times_s.append(now_s)
        self.last_unix_s = unix_s

    def rate_hz(self, now_s: float) -> float | None:
        """Of the last seconds; None for less than two."""
        recent = [at for at in self.times_s if now_s - at <= _RATE_OVER_S]
        if len(recent) < 2 or recent[-1] == recent[0]:
            return None
        return (len(recent) - 1) / (recent[-1] - recent[0])


class Allowance:
    """So many a second, and those of a second at once; what has been spent is told afterwards."""

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._left = per_s
        self._at_s = time.monotonic()

    def is_spent(self, now_s: float) -> bool:
        """Whether the next has to wait."""
        self._left = min(self._per_s, self._left + (now_s - self._at_s) * self._per_s)
        self._at_s = now_s
        return self._left < 0.0

    def spend(self, count: float) -> None:
        """So many were taken."""
        self._left -= count


class OtherSensors:
    """Health and marks of a session's sensors; the worker tells what its filter thinks."""

    def __init__(self) -> None:
        self._told: dict[str, dict[str, Any]] = {}  # by the filter
        self._arrivals: dict[str, Arrivals] = {}
        self._marks: dict[str, tuple[float, dict[str, Any]]] = {}
        self._forgotten: str | None = None

    @property
    def is_fused(self) -> bool:
        """Whether the session has, or had, a filter."""
        return bool(self._arrivals)

    def heard(self, sensor: str, now_s: float, unix_s: float, header: Header) -> None:
        """The worker took lines of a sensor."""
        self._arrivals.setdefault(sensor, Arrivals()).add(now_s, unix_s)
        if header["marks"] is not None:
            self._marks[sensor] = now_s, header["marks"]
        self.told(header)

    def told(self, header: Header) -> None:
        """What the filter thinks, where a message says it."""
        if "sensors" in header:
            self._told = header["sensors"]

    def forget(self, reason: str) -> None:
        """The filter has ended with its process."""
        self._told = {}
        self._marks.clear()
        self._forgotten = reason

    def marks(self, now_s: float) -> bytes:
        """JSON list of `Marks`, of the last seconds."""
        recent = [marks for at, marks in self._marks.values() if now_s - at <= _SHOWN_S]
        return json.dumps(recent).encode() if recent else b"[]"

    def trust_of(self, sensor: str) -> SensorTrust | None:
        """What the filter thinks of a sensor."""
        told = self._told.get(sensor)
        if told is None:
            return None
        names = SensorTrust.model_fields
        return SensorTrust(**{name: told[name] for name in names})

    def health(self, now_s: float) -> list[SensorHealth]:
        """All but the camera, in order of their first words."""
        found = []
        for name, arrivals in self._arrivals.items():
            if name == CAMERA:
                continue
            told = self._told.get(name)
            trust = self.trust_of(name)
            silent_s = now_s - arrivals.times_s[-1]
            reason = None
            if silent_s > _SILENT_S:
                reason = f"no line for {silent_s:.0f} s"
            elif trust is None:
                reason = self._forgotten
            elif trust.locked_out:
                reason = f"locked out: {trust.reason}"
            found.append(
                SensorHealth(
                    name=name,
                    kind="pose" if told is None else told["kind"],
                    healthy=reason is None,
                    reason=reason,
                    frames=0 if told is None else told["lines"],
                    drops=0,
                    rate_hz=arrivals.rate_hz(now_s),
                    last_unix_s=arrivals.last_unix_s,
                    trust=trust,
                )
            )
        return found
