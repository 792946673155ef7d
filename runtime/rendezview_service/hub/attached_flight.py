"""The flight that is attached to a session, and the orders that it has not received."""

from __future__ import annotations

import time

from rendezview_service.hub.inputs import Full
from rendezview_service.hub.session_events import SessionEvents
from rendezview_service.messages.approach_messages import Level
from rendezview_service.messages.flight_messages import Flight, Order

_SILENT_S = 10.0  # s without a report, then no flight is attached. Source: chosen, twenty steps
_MOST_WAITING = 32  # orders. Source: a chosen limit


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
