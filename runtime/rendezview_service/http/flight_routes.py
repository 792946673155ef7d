"""Routes of a flight that is attached to a session: its reports, and the operator's orders."""

from __future__ import annotations

from fastapi import APIRouter, Request
from starlette.exceptions import HTTPException

from rendezview_service.http.answers import FAULTS, needs, session_of
from rendezview_service.http.security import Right
from rendezview_service.messages.flight_messages import Flight, Order, Orders

router = APIRouter(prefix="/v1/sessions/{name}", tags=["flights"], responses=FAULTS)


@router.put("/flight")
async def report_flight(request: Request, name: str, flight: Flight) -> Orders:
    """A flight says what it does, at least every ten seconds; the orders since its last report."""
    needs(request, Right.TRACK)
    return Orders(orders=session_of(request, name).flight.reported(flight))


@router.post("/orders", status_code=204)
async def order(request: Request, name: str, order: Order) -> None:
    """An order of the operator to the flight, which takes it at its next step."""
    needs(request, Right.TRACK)
    if not session_of(request, name).flight.order(order):
        raise HTTPException(
            409, "no flight with this switch is attached: see `flight` of the session"
        )
