"""Messages of several sensors in one session: what is known of them, words in, one state out."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, field_validator, model_validator

from rendezview.fusion import FusionOptions
from rendezview.service.message_parts import (
    Matrix12,
    Message,
    Name,
    PoseMessage,
    Three,
    Two,
)

MOST_REMEMBERED = 400  # measurements of a filter: what a late one costs
MOST_MARKS = 256  # ellipses or spots of one line that are drawn
_MOST_HISTORY_S = 60.0
_MOST_NUMBER = 1e12


# What a session knows of its sensors


class RingMessage(Message):
    """The target's docking ring, target frame."""

    centre_m: Three
    axis: Three = Field(description="outward normal of its plane; any length but zero")
    radius_m: FiniteFloat = Field(gt=0.0, le=1e4)

    @field_validator("axis")
    @classmethod
    def _is_a_direction(cls, axis: list[float]) -> list[float]:
        return _direction(axis)


class SurfaceMessage(Message):
    """What a ranger's beam may meet: a plane, target frame."""

    point_m: Three
    normal: Three
    relief_m: FiniteFloat = Field(default=0.0, ge=0.0, le=1e4, description="σ about the plane")
    inner_m: FiniteFloat = Field(default=0.0, ge=0.0, description="where it begins, from the point")
    outer_m: FiniteFloat | None = Field(default=None, description="where it ends; null: nowhere")

    @field_validator("normal")
    @classmethod
    def _is_a_direction(cls, normal: list[float]) -> list[float]:
        return _direction(normal)

    @model_validator(mode="after")
    def _ends_beyond_its_beginning(self) -> Self:
        if self.outer_m is not None and not self.outer_m > self.inner_m:
            raise ValueError("outer_m must be beyond inner_m")
        return self


class FusionRequest(Message):
    """What the filter needs to know of a session's other sensors; all of it may be left out."""

    ring: RingMessage | None = Field(
        default=None, description="of ring logs, and what ranges meet where surfaces are not given"
    )
    surfaces: Annotated[list[SurfaceMessage], Field(max_length=32)] = Field(
        default=[], description="what a ranger's beam may meet, in order"
    )
    mounts: Annotated[dict[Name, PoseMessage], Field(max_length=32)] = Field(
        default={}, description="sensor_from_camera by the sensor's name; others are the camera's"
    )
    options: FusionOptions | None = Field(
        default=None, description="as `rendezview fuse --options` takes them"
    )

    @field_validator("mounts")
    @classmethod
    def _are_poses(cls, mounts: dict[str, PoseMessage]) -> dict[str, PoseMessage]:
        for name, mount in mounts.items():
            if not any(mount.quat_wxyz):
                raise ValueError(f"{name}: quat_wxyz must not be zero")
        return mounts

    @field_validator("options")
    @classmethod
    def _are_bounded(cls, options: FusionOptions | None) -> FusionOptions | None:
        if options is None:
            return None
        _check_numbers(asdict(options), "options")
        if not 0.0 <= options.history_s <= _MOST_HISTORY_S or options.history_most < 1:
            raise ValueError(f"history_s must be 0 … {_MOST_HISTORY_S:g}, history_most at least 1")
        if len(options.sensors) > 32:
            raise ValueError("options of at most 32 sensors")
        return options


def _direction(vector: list[float]) -> list[float]:
    if not 1e-6 < math.hypot(*vector) < 1e6:
        raise ValueError("a direction must not be zero")
    return vector


def _check_numbers(content: Any, where: str) -> None:
    """A filter with numbers beyond all measure says nothing of use."""
    if isinstance(content, dict):
        for name, part in content.items():
            _check_numbers(part, f"{where}.{str(name)[:40]}")
    elif isinstance(content, int | float) and not abs(content) <= _MOST_NUMBER:
        raise ValueError(f"{where} must be a number within ±{_MOST_NUMBER:g}")


# What comes out


class FusedRates(Message):
    """How the target moves in the camera frame, by all sensors."""

    angular_rad_s: Three
    linear_m_s: Three = Field(description="of the target frame's origin")


class Fused(Message):
    """The relative state by all sensors of the session."""

    time_s: float
    status: Literal["waiting", "starting", "tracking", "coasting", "lost", "late"] = Field(
        description="as docs/fusion.md has them; late: the frame is older than what is remembered"
    )
    reason: str | None
    pose: PoseMessage | None = Field(description="camera_from_target")
    rates: FusedRates | None
    covariance: Matrix12 | None = Field(
        description="rotation vector (rad), translation (m), angular rate (rad/s), velocity (m/s); "
        "camera frame, perturbation left"
    )
    ring_radius: float | None = Field(description="true over told, where it is estimated")
    ring_depth_m: float | None = Field(description="along its axis, where it is estimated")
    starts: int = Field(description="how often the filter began")


class Verdict(Message):
    """What became of a measurement."""

    time_s: float
    accepted: bool
    reason: str | None
    nis: float | None = Field(description="squared distance in σ; null: not compared")
    degrees_of_freedom: int
    began: bool = Field(description="the filter began here, or began anew")


class Measured(Message):
    """The answer to words of a sensor."""

    type: Literal["measured"] = "measured"
    session: str
    sensor: str
    verdicts: list[Verdict | None] = Field(description="one a line; null: it held no measurement")
    fused: Fused | None = Field(description="null while no other sensor has measured anything")
    recorded: bool = Field(description="all lines are in the log")


class LoggedMeasurement(Message):
    """A line of a sensor as a log keeps it."""

    session: str
    order: int = Field(description="of arrival, counted from 0 over the session's lines")
    frame: int = Field(description="frames looked at before it")
    sensor: str
    received_unix_s: float
    record: dict[str, Any] = Field(description="as it came")
    verdict: Verdict | None
    fused: Fused | None


# What is drawn over the frame


class EllipseMark(Message):
    """An ellipse in the picture."""

    centre_px: Two
    semi_axes_px: Two
    angle_rad: FiniteFloat = Field(description="of the long axis, from +x towards +y")


class Marks(Message):
    """What a sensor saw in the picture, by its newest line; pixels of the full frame."""

    sensor: str
    time_s: float
    ellipses: list[EllipseMark]
    chosen: int | None = Field(description="number of the ellipse that the poses are of")
    spots_px: list[Two]
