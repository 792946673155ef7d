"""Parts of all messages: their base, lists of fixed length, names, poses."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat

from rendezview.geometry.pose import Pose

CAMERA = "camera"  # name of the session's own camera among its sensors
# s, either side of zero; the stamps of a log hold no more. Source: a chosen limit.
MOST_TIME_S = 1e10
MOST_FIRST_S = 5e9  # s, of a session's first frame: others follow. Source: chosen, the year 2128
# s, of a frame after the one before, beyond what has passed meanwhile. Source: a chosen limit
MOST_JUMP_S = 3600.0
Two = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
Three = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
# Where a target is: x, y, width, height; x, y; or x, y, range
RegionNumbers = Annotated[list[FiniteFloat], Field(min_length=2, max_length=4)]
Six = Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]
Matrix6 = Annotated[list[Six], Field(min_length=6, max_length=6)]
Twelve = Annotated[list[FiniteFloat], Field(min_length=12, max_length=12)]
Matrix12 = Annotated[list[Twelve], Field(min_length=12, max_length=12)]


def _checked_length(vector: list[float]) -> list[float]:
    if not 1e-6 < math.hypot(*vector) < 1e6:
        raise ValueError("a direction or a turn must not be zero, nor longer than 1e6")
    return vector


Direction = Annotated[Three, AfterValidator(_checked_length)]
Quaternion = Annotated[
    list[FiniteFloat], Field(min_length=4, max_length=4), AfterValidator(_checked_length)
]
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


class Message(BaseModel):
    """Base of all messages: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid")


class FrameHead(Message):
    """The line of JSON before the picture of a frame in a stream."""

    time_s: Annotated[FiniteFloat, Field(ge=-MOST_TIME_S, le=MOST_TIME_S)] | None
    roi: RegionNumbers | None = None


class PoseMessage(Message):
    """camera_from_target: ``p_camera = R p_target + t``."""

    quat_wxyz: Quaternion
    translation_m: Three

    @property
    def pose(self) -> Pose:
        """As the package has it."""
        return Pose.from_quat_wxyz(self.quat_wxyz, self.translation_m)


class ProtectionLevels(Message):
    """Levels that the errors of a pose exceed with the session's risk, and alarms."""

    risk: float
    attitude_rad: float = Field(description="π: any attitude is possible")
    position_m: float | None = Field(description="of the translation; null: no level")
    axes: list[float | None] = Field(
        description="rotation vector rad, translation m; camera frame", min_length=6, max_length=6
    )
    wrong: float = Field(description="probability that another answer is the truth")
    drift: float = Field(description="largest cumulative sum of the innovations, σ")
    alarm: bool = Field(description="the pose must not be used")
    alarms: list[str] = Field(description="why: attitude, position, witnesses, drift")


class BudgetUse(Message):
    """How much is in use of what there is for all who send and read."""

    used: int
    most: int
    exceeded: bool = Field(default=False, description="in the last 10 s: somebody was refused")


class Fault(Message):
    """The body of every answer with a status of 400 or more."""

    error: str = Field(description="what is wrong, where, and what to do")
    status: int


class Health(Message):
    """``/healthz`` and ``/readyz``."""

    status: Literal["ok", "degraded", "not ready", "stopping"] = Field(
        description="degraded: it tracks, but not for every session, or cannot record"
    )
    reasons: list[str] = Field(default=[])
    version: str
    uptime_s: float
    sessions: int
    recording_failures: int
    budgets: dict[str, BudgetUse] = Field(
        default={},
        description="bodies_bytes, uploads_bytes, unread_bytes, history_bytes, connections, "
        "requests, websockets, downloads, watchers, sessions, barred_sessions",
    )
