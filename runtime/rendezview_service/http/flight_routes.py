"""Routes of a flight that is attached to a session: its reports, and the operator's orders."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.exceptions import HTTPException

from rendezview_service.http.answers import FAULTS, Tracked
from rendezview_service.messages.flight_messages import Flight, Order, Orders

router = APIRouter(prefix="/v1/sessions/{name}", tags=["flights"], responses=FAULTS)


@router.put("/flight")
async def report_flight(session: Tracked, flight: Flight) -> Orders:
    """A flight says what it does, at least every ten seconds; the orders since its last report."""
    return Orders(orders=session.flight.reported(flight))


@router.post("/orders", status_code=204)
async def order(session: Tracked, order: Order) -> None:
    """An order of the operator to the flight, which takes it at its next step."""
    if not session.flight.order(order):
        raise HTTPException(
            409, "no flight with this switch is attached: see `flight` of the session"
        )
