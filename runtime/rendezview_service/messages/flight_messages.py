"""Messages of a closed-loop flight: what it does, and what its operator orders."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from rendezview_service.messages.message_parts import Message, Name


class Flight(Message):
    """What a flight does, as it reports by itself at each of its steps."""

    time_s: FiniteFloat
    mode: Annotated[str, Field(max_length=40)] = Field(
        description="approach, hold, retreat or abort"
    )
    reason: Annotated[str, Field(max_length=400)] = Field(description="of a hold or a retreat")
    range_m: FiniteFloat | None = Field(description="port to port, by the fused state")
    switches: Annotated[dict[Name, bool], Field(max_length=32)] = Field(
        description="what an order may switch, and whether it is on: sensors, `hand`"
    )


class Order(Message):
    """What the operator wants of a flight."""

    do: Literal["hold", "go_on", "retreat", "switch"] = Field(
        description="retreat: to the hold point behind, and hold there"
    )
    what: Name | None = Field(
        default=None, description="of the flight's switches; `hand` covers the camera"
    )
    on: bool = Field(default=True, description="of a switch")


class Orders(Message):
    """The orders since a flight's last report, oldest first."""

    orders: list[Order]
