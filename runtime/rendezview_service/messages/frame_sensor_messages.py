"""Messages of the sensors that a session runs on its own frames, beside the tracker."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, FiniteFloat

from rendezview.trajectory import PlanFile, Shape
from rendezview_service.messages.fusion_messages import EllipseMark, Verdict
from rendezview_service.messages.message_parts import Matrix6, Message, PoseMessage, Three

_Five = Annotated[list[FiniteFloat], Field(min_length=5, max_length=5)]
_Matrix3 = Annotated[list[Three], Field(min_length=3, max_length=3)]

# The request


class TrajectoryRequest(Message):
    """The path to fit; every key is optional, but a shape or a plan is needed."""

    shape: Shape | None = Field(default=None, description="wins over that of the plan")
    plan: PlanFile | None = Field(default=None, description="the content of a plan file")
    centre_m: Three | None = Field(
        default=None,
        description="of the path, target frame, where the plan gives none; default: the ring's "
        "centre, else the view centre",
    )


class FrameSensorsRequest(Message):
    """What runs on the frames of a session, beside the tracker; null: if it is known."""

    ring: bool | None = Field(
        default=None, description="the ring sensor; null: if the session knows a docking ring"
    )
    reflectors: Literal["off", "single", "pairs"] = Field(
        default="off",
        description="single: each frame is a picture of lights; pairs: frames are lit and dark in "
        "turn, the first one lit",
    )
    trajectory: TrajectoryRequest | bool | None = Field(
        default=None,
        description="the fit of the path; null: with a plan, or (a V-bar) with a docking ring",
    )
    fusion: bool | None = Field(
        default=None,
        description="the filter runs from the first frame on; null: if ring or reflectors are "
        "read. If not, it starts with the first line of another sensor",
    )

    @property
    def any(self) -> bool:
        """Whether a sensor runs, or a path is fitted: with loops of their own."""
        return bool(self.ring or self.trajectory) or self.reflectors != "off"


# The answers


class CircleReading(Message):
    """A pose of the ring's circle, camera frame."""

    centre_m: Three
    axis: Three = Field(description="unit, towards the camera")
    covariance: Annotated[list[_Five], Field(min_length=5, max_length=5)] | None = Field(
        description="centre (m), axis (rad) along e₁ and e₂, as docs/ring.md has them"
    )
    chosen: bool | None = Field(default=None, description="absent in candidates")
    reason: str | None = None


class RingCandidate(Message):
    """An ellipse that may be the ring's, and the poses that it allows."""

    ellipse: EllipseMark
    poses: list[CircleReading]


class RingReading(Message):
    """What the ring sensor saw in the frame: the line of `rendezview ring`, one ellipse of it."""

    status: str = Field(description="ok, ambiguous, not found")
    reason: str | None
    ellipse: EllipseMark | None = Field(
        description="of the poses; pixels of the camera without its lens distortion"
    )
    poses: list[CircleReading]
    candidates: list[RingCandidate] = Field(description="if it is open which ellipse is the ring")
    verdict: Verdict | None = Field(description="of the filter; null: nothing to fuse")


class SpotReading(Message):
    """A spot that is a reflector's."""

    model_config = ConfigDict(extra="allow")  # size, brightness … as in the log

    x_px: float
    y_px: float
    reflector: str


class ReflectorReading(Message):
    """What the reflector sensor saw: the line of `rendezview reflectors`, with the named spots."""

    model_config = ConfigDict(extra="allow")  # triplet, tracked … as in the log

    time_s: float = Field(description="of the lit frame")
    status: str
    reason: str | None
    pose: PoseMessage | None
    covariance: Matrix6 | None
    six: dict[str, float] | None = Field(description="range, azimuth … as docs/reflectors.md has")
    spots: list[SpotReading]
    verdict: Verdict | None


class SegmentReading(Message):
    """A fitted segment of the path; the shape's own numbers come beside these keys."""

    model_config = ConfigDict(extra="allow")

    shape: Shape
    start_s: float
    place_m: Three
    velocity_m_s: Three
    place_covariance_m2: _Matrix3
    frames: int
    points: int
    gap_sigma: float = Field(description="largest step of Gauss–Newton from the answer, in σ")
    path_m: list[Three] = Field(description="from its start to now, about the centre")
    predicted_m: list[Three] = Field(description="from now, for the same time")


class CorrectionReading(Message):
    """The way back to the plan."""

    reach_s: float = Field(description="when the plan is met again")
    error_m: Three
    predicted_error_m: Three
    predicted_sigma_m: float
    delta_v_m_s: Three
    direction: Three | None
    arrival_delta_v_m_s: Three


class Trajectory(Message):
    """The fit of the path: the record ``trajectory`` of `rendezview track` and `guide`."""

    time_s: float = Field(description="of the last frame in it")
    number: int = Field(description="of the segment, from 0")
    ended: bool
    centre_m: Three = Field(description="target frame; places are about it, in the path's axes")
    path_from_target: _Matrix3
    segment: SegmentReading | None
    segment_reason: str | None = None
    correction: CorrectionReading | None = Field(default=None, description="absent without a plan")
    correction_reason: str | None = None
    spin: dict[str, Any] | None = Field(default=None, description="as in the log of `track`")
    spin_reason: str | None = None
