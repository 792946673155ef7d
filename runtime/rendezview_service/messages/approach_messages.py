"""Messages of an approach: the docking port, its corridor and limits, and the numbers of a frame.

Angles are radians, except in limits, which people write: degrees.
"""

from __future__ import annotations

from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, field_validator, model_validator

from rendezview_service.messages.fusion_messages import FusedRates
from rendezview_service.messages.message_parts import (
    Direction,
    Matrix6,
    Message,
    Name,
    PoseMessage,
    Three,
)

_Length = Annotated[FiniteFloat, Field(gt=0.0, le=1e6)]

# The request


class PortMessage(Message):
    """A docking port, target frame."""

    centre_m: Three
    axis: Direction = Field(description="outward normal, of any length but zero")
    up: Direction | None = Field(
        default=None,
        description="the chaser's up (−y of its camera) when docked; default: the target's z, or "
        "its x where the axis is near z",
    )


class CorridorMessage(Message):
    """The cone, about the port's axis, in which the chaser should come."""

    half_angle_deg: FiniteFloat = Field(gt=0.0, lt=90.0)
    radius_m: FiniteFloat = Field(default=0.0, ge=0.0, le=1e6, description="at the port")
    length_m: _Length = Field(description="from the port; farther away nothing is asked")


Quantity = Literal[
    "range_m", "range_sigma_m", "range_rate_m_s", "along_m", "lateral_m", "lateral_rate_m_s",
    "miss_m", "plan_m", "bearing_deg", "off_axis_deg", "roll_deg", "pitch_deg", "yaw_deg",
    "misalignment_deg", "turn_rate_deg_s",
]  # fmt: skip


class Level(StrEnum):
    """How serious an event is."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"


class LimitMessage(Message):
    """A bound on a quantity."""

    quantity: Quantity
    least: FiniteFloat | None = None
    most: FiniteFloat | None = None
    within_m: _Length | None = Field(default=None, description="only at this range or nearer")
    level: Literal[Level.WARNING, Level.ALARM] = Level.ALARM

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.least is None and self.most is None:
            raise ValueError("give least, most or both")
        return self


class WayPoint(Message):
    """A place of the planned path."""

    time_s: FiniteFloat = Field(ge=-1e10, le=1e10, description="of the frames' clock")
    position_m: Three = Field(description="of the probe, target frame")


class ApproachRequest(Message):
    """What the approach is to be compared with; every key is optional."""

    port: PortMessage | None = Field(default=None, description="default: the docking ring")
    probe_from_camera: PoseMessage | None = Field(
        default=None,
        description="the chaser's own port, axes as a camera's; default: the camera itself",
    )
    corridor: CorridorMessage | None = None
    keep_out_m: _Length | None = Field(
        default=None,
        description="radius about the view centre that is entered in the corridor only",
    )
    limits: Annotated[list[LimitMessage], Field(max_length=64)] = Field(default=[])
    plan: Annotated[list[WayPoint], Field(max_length=5000)] = Field(
        default=[], description="in order of time; straight between them"
    )
    start_unix_s: FiniteFloat | None = Field(
        default=None, ge=0.0, le=1e10, description="of mission time; default: the session's start"
    )

    @field_validator("plan")
    @classmethod
    def _check_plan(cls, plan: list[WayPoint]) -> list[WayPoint]:
        if any(b.time_s <= a.time_s for a, b in pairwise(plan)):
            raise ValueError("times must rise")
        return plan


# The answer


class Motion(Message):
    """The filter's state at a frame; without a pose of the frame it is the prediction."""

    status: Literal["waiting", "starting", "tracking", "coasting", "lost", "late"]
    reason: str | None
    pose: PoseMessage | None = Field(description="camera_from_target")
    covariance: Matrix6 | None = Field(
        description="rotation vector (rad), translation (m); camera frame, perturbation left"
    )
    rates: FusedRates | None
    angular_sigma_rad_s: Three | None
    linear_sigma_m_s: Three | None


class Alarm(Message):
    """A limit that is exceeded."""

    level: Level
    quantity: str
    text: str


class Approach(Message):
    """The chaser beside the port (without one: beside the view centre), by the filter."""

    range_m: float = Field(description="from the probe to the port")
    range_sigma_m: float
    range_rate_m_s: float
    range_rate_sigma_m_s: float
    azimuth_rad: float = Field(description="of the port from the probe's boresight, to the right")
    elevation_rad: float = Field(description="the same, upwards")
    turn_rate_rad_s: float
    along_m: float | None = Field(description="of the probe before the port, along its axis")
    right_m: float | None = Field(description="of the axis, as the chaser sees it")
    up_m: float | None
    along_rate_m_s: float | None
    right_rate_m_s: float | None
    up_rate_m_s: float | None
    off_axis_rad: float | None = Field(description="of the probe from the port's axis")
    roll_rad: float | None = Field(description="misalignment, clockwise as the chaser sees it")
    pitch_rad: float | None = Field(description="misalignment, upwards")
    yaw_rad: float | None = Field(description="misalignment, to the right")
    contact_s: float | None = Field(description="until the port's plane at the present rate")
    miss_m: float | None = Field(description="from the port's centre, there")
    in_corridor: bool | None = Field(description="null: there is none, or it does not reach here")
    in_keep_out: bool | None
    plan_m: float | None = Field(description="from the planned place; null: no plan for this time")
    alarms: list[Alarm]


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
