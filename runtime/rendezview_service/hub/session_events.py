"""What happened in a session, for the operator; and the flight that is attached to it."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rendezview_service.hub.inputs import Full
from rendezview_service.messages.approach_messages import Flight, Level, Order
from rendezview_service.messages.messages import Event, Phase, Recording, RecordingState

log = logging.getLogger("rendezview_service")

_KEPT = 500  # events. Source: a chosen limit
_CLEAR_S = 2.0  # s, for which a limit must hold before its alarm ends. Source: chosen
_SILENT_S = 10.0  # s without a report, then no flight is attached. Source: chosen, twenty steps
_MOST_WAITING = 32  # orders. Source: a chosen limit


class SessionEvents:
    """The newest events of a session, and the alarms that stand."""

    def __init__(self, session: str | None, unix_s: Callable[[], float]) -> None:
        """No events yet.

        Args:
            session: for the service's own log; None: that has them already.
            unix_s: the session's clock, s.
        """
        self._session = session
        self._unix_s = unix_s
        self._kept: deque[Event] = deque(maxlen=_KEPT)
        self._count = 0
        self._phase = Phase.WAITING
        self._recording: RecordingState | None = None
        self._log_faults = 0
        self._alarms: dict[tuple[str, str], tuple[str, float]] = {}  # text, last seen
        self._fault: str | None = None
        self._restarts = 0

    @property
    def alarms(self) -> list[str]:
        """Texts of the alarms that stand."""
        return [text for text, _ in self._alarms.values()]

    def since(self, number: int) -> list[Event]:
        """Events from a number on."""
        return [event for event in self._kept if event.number >= number]

    def add(self, kind: str, level: Level, text: str) -> None:
        """Something happened."""
        event = Event(
            number=self._count, unix_s=self._unix_s(), level=level, kind=kind, text=text[:400]
        )
        self._count += 1
        self._kept.append(event)
        if self._session is not None:
            log.info("event", extra={"session": self._session, "kind": kind, "text": event.text})

    def phase(self, phase: Phase, frame: int, status: str) -> None:
        """The phase of a frame."""
        if phase is self._phase:
            return
        self._phase = phase
        level = Level.INFO if phase is Phase.TRACKING else Level.WARNING
        level = Level.ALARM if phase is Phase.SEARCHING else level
        self.add("phase", level, f"{phase} ({status}, frame {frame})")

    def limits(self, found: list[dict[str, Any]], now_s: float) -> None:
        """The limits that a frame exceeds."""
        for alarm in found:
            key = alarm["level"], alarm["quantity"]
            if key not in self._alarms:
                self.add("alarm", Level(alarm["level"]), alarm["text"])
            self._alarms[key] = alarm["text"], now_s
        for key, (text, seen_s) in list(self._alarms.items()):
            if now_s - seen_s > _CLEAR_S:
                del self._alarms[key]
                self.add("alarm", Level.INFO, f"no longer: {text}")

    def restarted(self, starts: int, reason: str | None) -> None:
        """How often the filter has started, and why it last restarted."""
        if starts > max(self._restarts, 1):
            self.add("fusion", Level.WARNING, reason or "restarted")
        self._restarts = starts

    def recording(self, recording: Recording) -> None:
        """The state of the log."""
        faults, self._log_faults = self._log_faults, recording.faults
        if recording.state is self._recording:
            if recording.fault is not None and recording.faults > faults:
                self.add("recording", Level.ALARM, f"goes on: {recording.fault}")
            return
        began, self._recording = self._recording is None, recording.state
        if recording.state is RecordingState.FAILED:
            self.add("recording", Level.ALARM, f"failed: {recording.reason}")
        elif not began or recording.state is RecordingState.ON:
            self.add("recording", Level.INFO, f"{recording.state}: {recording.name or ''}")

    def fault(self, error: str | None) -> None:
        """A frame was refused, or the source fails; None: a frame was tracked."""
        if error is not None and error != self._fault:
            self.add("source", Level.WARNING, error)
        self._fault = error


def events_of(states: list[dict[str, Any]]) -> list[Event]:
    """Phases, alarms and restarts of the filter in recorded states."""
    at_s = 0.0
    events = SessionEvents(None, lambda: at_s)
    for state in states:
        at_s = state["received_unix_s"]
        events.phase(Phase(state["phase"]), state["frame"], state["status"])
        events.limits((state.get("approach") or {}).get("alarms", []), at_s)
        if fused := state.get("fused"):
            events.restarted(fused["starts"], fused["note"])
    return events.since(0)


class AttachedFlight:
    """The last report of a flight, and orders for it."""

    def __init__(self, events: SessionEvents) -> None:
        self._events = events
        self._last: tuple[Flight, float] | None = None
        self._orders: list[Order] = []

    @property
    def report(self) -> Flight | None:
        """What the flight last reported; None: none is attached."""
        if self._last is None or time.monotonic() - self._last[1] > _SILENT_S:
            return None
        return self._last[0]

    def reported(self, flight: Flight) -> list[Order]:
        """Take a report, and give the orders since the last one."""
        if self.report is None or self.report.mode != flight.mode:
            self._events.add("flight", Level.INFO, f"{flight.mode}: {flight.reason}".rstrip(": "))
        self._last = flight, time.monotonic()
        orders, self._orders = self._orders, []
        return orders

    def order(self, order: Order) -> bool:
        """Keep an order for the flight; False: it has no such switch, or none is attached.

        Raises:
            Full: the flight has not taken earlier ones.
        """
        report = self.report
        if report is None or (order.do == "switch" and order.what not in report.switches):
            return False
        if len(self._orders) >= _MOST_WAITING:
            raise Full
        self._orders.append(order)
        said = f"{order.what} {'on' if order.on else 'off'}" if order.do == "switch" else order.do
        self._events.add("operator", Level.WARNING, said.replace("_", " "))
        return True
