"""The clock of a session: it starts at the time of day and never jumps."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SessionClock:
    """Monotonic time and one offset: a step of the system's clock does not reach a session."""

    offset_s: float

    @classmethod
    def started_now(cls) -> SessionClock:
        """The clock of a session that begins."""
        return cls(time.time() - time.monotonic())

    def unix_s(self, now_s: float) -> float:
        """Seconds since 1970 at a monotonic time, by the system's clock at the session's start."""
        return now_s + self.offset_s
