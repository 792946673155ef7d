"""Messages of a session with several sensors: data on them, their lines, the fused state."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, field_validator, model_validator

from rendezview.fusion import FusionOptions
from rendezview_service.messages.message_parts import (
    Direction,
    Matrix12,
    Message,
    Name,
    PoseMessage,
    ProtectionLevels,
    Three,
    Two,
)

# measurements in a filter's history; bounds the cost of a late one. Source: a chosen limit.
MOST_REMEMBERED = 400
MOST_MARKS = 256  # ellipses or spots of one line that are drawn. Source: a chosen limit
_MOST_HISTORY_S = 60.0  # s. Source: a chosen limit
_MOST_NUMBER = 1e12  # of any option. Source: a chosen limit


MOST_CIRCLES = 32  # beside a ring. Source: a chosen limit
# of a group, and of all: the work of making a pattern grows with the factorial of a group
MOST_OF_GROUP, MOST_REFLECTORS = 8, 32  # Source: chosen limits

# Data on the sensors of a session

CircleMessage = tuple[
    Annotated[FiniteFloat, Field(ge=-1e4, le=1e4)], Annotated[FiniteFloat, Field(gt=0.0, le=1e4)]
]


class RingMessage(Message):
    """The target's docking ring, target frame."""

    centre_m: Three
    axis: Direction = Field(description="outward normal of its plane, of any length but zero")
    radius_m: FiniteFloat = Field(gt=0.0, le=1e4)
    circles: list[CircleMessage] = Field(
        default=[],
        max_length=MOST_CIRCLES,
        description="other circles about the same axis: height over the ring's plane, radius, m",
    )


class ReflectorMessage(Message):
    """A reflector or light of the target, target frame."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    group: Annotated[str, Field(min_length=1, max_length=64)] = Field(
        description="those of one group are looked for together; three or more"
    )
    position_m: Three
    normal: Direction = Field(description="outwards, of any length but zero")
    diameter_m: FiniteFloat = Field(gt=0.0, le=1e4)
    position_sigma_m: FiniteFloat | None = Field(
        default=None, ge=0.0, le=1e4, description="one σ of its place; null: not known"
    )


class SurfaceMessage(Message):
    """A plane of the target that a ranger's beam may hit, target frame."""

    point_m: Three
    normal: Direction
    relief_m: FiniteFloat = Field(default=0.0, ge=0.0, le=1e4, description="σ about the plane")
    inner_m: FiniteFloat = Field(default=0.0, ge=0.0, description="inner radius about the point")
    outer_m: FiniteFloat | None = Field(default=None, description="outer radius; null: unlimited")

    @model_validator(mode="after")
    def _check_radii(self) -> Self:
        if self.outer_m is not None and not self.outer_m > self.inner_m:
            raise ValueError("outer_m must be larger than inner_m")
        return self


class FusionRequest(Message):
    """Data on a session's sensors; every key is optional."""

    ring: RingMessage | None = Field(default=None, description="for the ring sensor and ring logs")
    reflectors: Annotated[list[ReflectorMessage], Field(max_length=MOST_REFLECTORS)] = Field(
        default=[], description="of the target, for the reflector sensor"
    )
    surfaces: Annotated[list[SurfaceMessage], Field(max_length=32)] = Field(
        default=[], description="that a ranger's beam may hit, in order; default: the model's mesh"
    )
    mounts: Annotated[dict[Name, PoseMessage], Field(max_length=32)] = Field(
        default={}, description="sensor_from_camera by sensor; default: at the camera"
    )
    options: FusionOptions | None = Field(
        default=None, description="as for `rendezview fuse --options`"
    )

    @field_validator("reflectors")
    @classmethod
    def _check_reflectors(cls, reflectors: list[ReflectorMessage]) -> list[ReflectorMessage]:
        names, groups = [r.name for r in reflectors], Counter(r.group for r in reflectors)
        if len(set(names)) < len(names):
            raise ValueError("give each reflector a name of its own")
        if groups and max(groups.values()) > MOST_OF_GROUP:
            raise ValueError(f"a group has at most {MOST_OF_GROUP} reflectors")
        return reflectors

    @field_validator("options")
    @classmethod
    def _check_options(cls, options: FusionOptions | None) -> FusionOptions | None:
        if options is None:
            return None
        _check_numbers(asdict(options), "options")
        if not 0.0 <= options.history_s <= _MOST_HISTORY_S or options.history_most < 1:
            raise ValueError(f"history_s must be 0 … {_MOST_HISTORY_S:g}, history_most at least 1")
        if len(options.sensors) > 32:
            raise ValueError("options of at most 32 sensors")
        return options


def _check_numbers(content: Any, where: str) -> None:
    """Refuse numbers that overflow in the filter."""
    if isinstance(content, dict):
        for name, part in content.items():
            _check_numbers(part, f"{where}.{str(name)[:40]}")
    elif isinstance(content, int | float) and not abs(content) <= _MOST_NUMBER:
        raise ValueError(f"{where} must be a number within ±{_MOST_NUMBER:g}")


# The answers


class FusedRates(Message):
    """Motion of the target in the camera frame, by all sensors."""

    angular_rad_s: Three
    linear_m_s: Three = Field(description="of the target frame's origin")


class Fused(Message):
    """The relative state by all sensors of the session."""

    time_s: float
    status: Literal["waiting", "starting", "tracking", "coasting", "lost", "late"] = Field(
        description="as docs/fusion.md has them; late: the frame is older than the filter's history"
    )
    reason: str | None
    pose: PoseMessage | None = Field(description="camera_from_target")
    rates: FusedRates | None = Field(description="null while starting, too")
    covariance: Matrix12 | None = Field(
        description="rotation vector (rad), translation (m), angular rate (rad/s), velocity (m/s); "
        "camera frame, perturbation left"
    )
    ring_radius: float | None = Field(description="true radius over the given one, if estimated")
    ring_depth_m: float | None = Field(description="offset along its axis, if estimated")
    ring_covariance: list[list[float]] | None = Field(
        default=None, description="2 × 2, of the radius (relative) and the offset (m)"
    )
    protection: ProtectionLevels | None = Field(
        default=None, description="how far off the pose may be, and whether sensors contradict it"
    )
    starts: int = Field(description="how often the filter has started")
    note: str | None = Field(default=None, description="why it last restarted")


class Verdict(Message):
    """The filter's decision on a measurement."""

    time_s: float
    accepted: bool
    reason: str | None
    nis: float | None = Field(description="normalised innovation squared; null: not compared")
    degrees_of_freedom: int
    began: bool = Field(description="the filter started or restarted here")


class Measured(Message):
    """The answer to lines of a sensor."""

    type: Literal["measured"] = "measured"
    session: str
    sensor: str
    verdicts: list[Verdict | None] = Field(description="one per line; null: no measurement")
    fused: Fused | None = Field(description="null before the first measurement of another sensor")
    recorded: bool = Field(description="all lines are in the log")
    record: str | None = Field(default=None, description="as that of a state")


class LoggedMeasurement(Message):
    """A line of a sensor as the log keeps it."""

    session: str
    order: int = Field(description="order of arrival, from 0 over the session's lines")
    frame: int = Field(description="number of frames tracked before it")
    sensor: str
    received_unix_s: float
    record: dict[str, Any] = Field(description="as it arrived")
    verdict: Verdict | None
    fused: Fused | None


# Drawn over the frame


class EllipseMark(Message):
    """An ellipse in the image."""

    centre_px: Two
    semi_axes_px: Two
    angle_rad: FiniteFloat = Field(description="of the long axis, from +x towards +y")


class Marks(Message):
    """Ellipses and spots of a sensor's newest line; pixels of the full frame."""

    sensor: str
    time_s: float
    ellipses: list[EllipseMark]
    chosen: int | None = Field(description="index of the ellipse that the poses belong to")
    spots_px: list[Two]
