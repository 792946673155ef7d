"""The clock of a session, which never jumps, and timers that bear a pause of the service."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

PAUSE_S = 0.5  # s, by which a timer is late after a pause of the service. Source: chosen


@dataclass(frozen=True, slots=True)
class SessionClock:
    """Monotonic time and one offset: a step of the system's clock does not reach a session."""

    offset_s: float

    @classmethod
    def started_now(cls) -> SessionClock:
        """The clock of a session that begins."""
        return cls(time.time() - time.monotonic())

    @property
    def now_unix_s(self) -> float:
        """Seconds since 1970 now."""
        return self.unix_s(time.monotonic())

    def unix_s(self, now_s: float) -> float:
        """Seconds since 1970 at a monotonic time, by the system's clock at the session's start."""
        return now_s + self.offset_s


class Timer:
    """Calls back after a time in which this process ran.

    A timer that is late says that the process was stopped. What was waited for has perhaps come
    meanwhile, but timers come before sockets: so the time starts again.
    """

    def __init__(self, delay_s: float, call: Callable[[], object]) -> None:
        """Start it, in the loop that runs."""
        self._loop, self._call = asyncio.get_running_loop(), call
        self.paused_s = 0.0  # for which the process was stopped
        self.start(delay_s)

    def start(self, delay_s: float) -> None:
        """Start it again."""
        self._delay_s, self._due_s = delay_s, time.monotonic() + delay_s
        self._handle = self._loop.call_later(delay_s, self._come)

    def cancel(self) -> None:
        """Do not call."""
        self._handle.cancel()

    def _come(self) -> None:
        late_s = time.monotonic() - self._due_s
        if late_s > PAUSE_S:
            self.paused_s += late_s
            self.start(self._delay_s)
        else:
            self._call()
