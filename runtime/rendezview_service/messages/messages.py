"""Messages of sessions: requests, states, and what watchers receive. All are validated.

Field names carry units; frames and covariances follow ``docs/conventions.md``. A value that cannot
be measured is ``null``, with a status and a reason beside it.
"""

from __future__ import annotations

import warnings
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, ModelWrapValidatorHandler, PrivateAttr, model_validator

from rendezview.geometry.camera import LensModel
from rendezview_service.messages.approach_messages import (
    Approach,
    ApproachRequest,
    Flight,
    Level,
    Motion,
)
from rendezview_service.messages.frame_sensor_messages import (
    FrameSensorsRequest,
    ReflectorReading,
    RingReading,
    Trajectory,
)
from rendezview_service.messages.fusion_messages import Fused, FusionRequest, Marks
from rendezview_service.messages.message_parts import (
    Direction,
    Matrix6,
    Message,
    Name,
    PoseMessage,
    ProtectionLevels,
    RegionNumbers,
    Three,
)

# Opening a session


class CameraMessage(Message):
    """A calibrated camera; pixel (0, 0) is the centre of the top-left pixel."""

    width: int = Field(ge=16, le=16384, description="px")
    height: int = Field(ge=16, le=16384, description="px")
    fx: FiniteFloat = Field(gt=0.0, le=1e7, description="px")
    fy: FiniteFloat = Field(gt=0.0, le=1e7, description="px")
    cx: FiniteFloat = Field(ge=-1e6, le=1e6, description="px")
    cy: FiniteFloat = Field(ge=-1e6, le=1e6, description="px")
    distortion: list[FiniteFloat] = Field(
        default=[],
        max_length=14,
        description="OpenCV's order: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]]; "
        "of a fisheye k1 k2 k3 k4",
    )
    lens_model: LensModel = Field(
        default=LensModel.OPENCV, description="fisheye: Kannala–Brandt, as cv2.fisheye"
    )
    bit_depth: int | None = Field(None, ge=8, le=16, description="of 16-bit PNG frames; null: 16")
    covariance: list[list[FiniteFloat]] | None = Field(
        default=None, max_length=18, description="of fx fy cx cy [distortion]; null: not known"
    )
    checked: bool = Field(default=False, description="its numbers are meant: no warnings")


class IntegrityRequest(Message):
    """Protection levels and alarms for the poses of a session."""

    risk: FiniteFloat = Field(
        default=1e-3, ge=1e-9, le=0.1, description="probability that an error exceeds its level"
    )
    alarm_attitude_rad: FiniteFloat | None = Field(
        default=None, gt=0.0, description="alarm where the level of the attitude is higher"
    )
    alarm_position_m: FiniteFloat | None = Field(
        default=None, gt=0.0, description="alarm where the level of the position is higher"
    )


class SessionRequest(Message):
    """A camera and a target to track."""

    id: Name | None = Field(default=None, description="chosen by the service where absent")
    model: Name | None = Field(default=None, description="optional if the service has one model")
    camera: CameraMessage | None = Field(
        default=None, description="optional if the service was started with one"
    )
    prior: PoseMessage | None = Field(
        default=None, description="pose at the first frame, attitude within about 20°"
    )
    prior_posterior: float = Field(
        default=1.0, ge=0.0, le=1.0, description="probability of the prior among its look-alikes"
    )
    sun_camera: Direction | None = Field(default=None, description="towards the Sun, camera frame")
    roi: RegionNumbers | None = Field(
        default=None, description="target at first: x, y, width, height, px; x, y; or x, y, range"
    )
    trees: bool = Field(default=True, description="find active nodes on every frame")
    record: bool | None = Field(default=None, description="default: the service's setting")
    idle_s: FiniteFloat | None = Field(
        default=None,
        ge=1.0,
        le=86_400.0,
        description="without a frame for longer it ends; default: the service's setting, 60 s",
    )
    fusion: FusionRequest | None = Field(
        default=None, description="data on sensors; required only for rings, lights and ranges"
    )
    sensors: FrameSensorsRequest | None = Field(
        default=None, description="what runs on the frames; default: what the target has"
    )
    approach: ApproachRequest | None = Field(
        default=None, description="docking port, corridor, keep-out zone, limits"
    )
    integrity: IntegrityRequest | None = Field(
        default=None, description="poses get protection levels; those with an alarm are not fused"
    )
    _notes: list[str] = PrivateAttr(default_factory=list)

    @model_validator(mode="wrap")
    @classmethod
    def _note_warnings(cls, content: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", DeprecationWarning)
            made = handler(content)
        made._notes += [str(one.message) for one in caught]
        return made

    @property
    def notes(self) -> list[str]:
        """What of it is out of date and ignored, or odd."""
        return self._notes


class Phase(StrEnum):
    """Phase of the tracking; the operator sees it first."""

    WAITING = "waiting"  # no frame yet
    TRACKING = "tracking"  # the last frame gave a pose
    COASTING = "coasting"  # the last frame gave none, but a recent one did
    SEARCHING = "searching"  # no recent pose: all attitudes are searched


class SensorHealth(Message):
    """One source of measurements of a session."""

    name: str
    kind: Literal["camera", "pose", "ring", "range", "rate", "thrust"] = Field(
        description="the session's own camera, or the kind of another sensor's lines"
    )
    healthy: bool
    reason: str | None = Field(description="if not healthy")
    frames: int = Field(description="tracked; for other sensors: lines")
    drops: int = Field(description="frames replaced by a newer one before they were tracked")
    rate_hz: float | None = Field(description="over the last seconds")
    last_unix_s: float | None = Field(description="arrival of the last frame or line")
    trust: SensorTrust | None = Field(
        default=None, description="the filter's opinion; null: no filter runs"
    )


class SensorTrust(Message):
    """How the filter judges a sensor."""

    heard: int = Field(description="measurements")
    accepted: int
    silent: int = Field(description="lines or frames without a measurement")
    locked_out: bool
    lockouts: int
    mean_nis: float | None = Field(description="per degree of freedom; 1 is expected")
    reason: str | None = Field(description="if the last measurement was rejected")


class RecordingState(StrEnum):
    """Whether states are recorded."""

    OFF = "off"
    ON = "on"
    FAILED = "failed"  # for example, the disk is full; tracking continues


class Recording(Message):
    """The log of a session."""

    state: RecordingState
    reason: str | None = Field(default=None, description="of a failure")
    name: str | None = Field(default=None, description="of the file")
    messages: int = 0
    size_bytes: int = Field(default=0, description="of that file")
    parts: int = Field(default=0, description="number of the file, from 1")
    all_bytes: int = Field(default=0, description="of all files since the worker's start")
    lost: int = Field(default=0, description="states and lines that are in no file")
    pending: int = Field(default=0, description="states and lines that wait for the disk")
    faults: int = Field(default=0, description="of its files, since the worker's start")
    fault: str | None = Field(default=None, description="the last one, for half a minute")


class SessionInfo(Message):
    """The present state of a session."""

    id: str
    model: str
    model_sha256: str = Field(description="of the model's file, hexadecimal")
    camera: CameraMessage
    source: str | None = Field(
        description="the source that the service reads; null: clients send frames"
    )
    phase: Phase
    created_unix_s: float
    frames: int
    drops: int
    found_fraction: float | None = Field(description="fraction of the frames with a pose")
    watchers: int
    last_frame: int | None
    last_time_s: float | None
    since_pose_s: float | None = Field(description="frame time since the last pose")
    age_s: float | None = Field(description="of the last state, by the service's own clock")
    alarms: list[str] = Field(description="that stand now")
    sensors: list[SensorHealth]
    on_frames: FrameSensorsRequest = Field(description="what runs on its frames")
    recording: Recording
    finished: bool = Field(description="the source has ended or failed")
    reason: str | None = Field(default=None, description="if the source failed")
    warnings: list[str] = Field(default=[], description="what of its request is ignored, or odd")
    flight: Flight | None = Field(default=None, description="that is attached: `rendezview fly`")


class SessionList(Message):
    """All sessions."""

    sessions: list[SessionInfo]


# Results of a frame


class Rates(Message):
    """Motion of the target in the camera frame, from the last two poses; `Motion` is filtered."""

    angular_rad_s: Three
    linear_m_s: Three = Field(description="of the view centre")


class ActiveNode(Message):
    """A node of the view sphere that recognised the frame."""

    index: int
    weight: float
    direction: Three = Field(description="unit, target frame, from the view centre to the camera")


class Fit(Message):
    """Agreement of the best refined pose with the frame, reported or not."""

    outline: float = Field(
        description="fraction of the outline's edges where the pose predicts them"
    )
    inner: float = Field(description="the same for creases and steps")
    seen: float = Field(description="fraction of the outline inside the image")
    residual_px: float
    margin: float = Field(description="score above that of the next best pose")


class ObservationMessage(Message):
    """The record of a frame that every sensor gives: the keys of `Observation.record`."""

    time_s: float = Field(description="of the frame, as given by its sender")
    status: str = Field(description="ok, empty, full, border, small, rivals, … as in `track`")
    reason: str | None
    pose: PoseMessage | None = Field(description="camera_from_target")
    covariance: Matrix6 | None = Field(
        description="rotation vector (rad), translation (m); camera frame, perturbation left"
    )
    stage_ms: dict[str, float]


class State(ObservationMessage):
    """The result of one frame. Without a pose it has a status and a reason."""

    session: str
    frame: int = Field(description="number in the session, counted from 0 over tracked frames")
    received_unix_s: float
    phase: Phase
    confidence: float | None
    score: float
    range_m: float | None = Field(description="of the view centre")
    rates: Rates | None
    candidates: list[PoseMessage] = Field(description="poses that fit but are not reported")
    fit: Fit | None
    on_nodes: list[ActiveNode]
    roi: RegionNumbers | None = Field(default=None, description="as its sender gave it")
    track_ms: float = Field(description="of the tracker, all stages")
    latency_ms: float = Field(description="from the frame's arrival to this answer")
    drops: int = Field(description="frames of the session that newer ones replaced, so far")
    recorded: bool = Field(description="this state is in the log")
    record: str | None = Field(
        default=None,
        description="recorded; pending: it waits for the disk, `recording` has its fate; "
        "failed: it will be in no file; both with a reason",
    )
    model_sha256: str | None = Field(default=None, description="of the model's file, hexadecimal")
    motion: Motion | None = Field(
        default=None,
        description="by the filter of all sensors; by that of the camera where it is the only one, "
        "or only its filter tracks",
    )
    approach: Approach | None = Field(
        default=None, description="the operator's numbers; null while the filter has no pose"
    )
    fused: Fused | None = Field(
        default=None, description="by all sensors; absent while the camera is the only one"
    )
    ring: RingReading | None = Field(
        default=None, description="absent where the ring sensor does not run"
    )
    reflectors: ReflectorReading | None = Field(
        default=None, description="null for a lit frame: the reading comes with its dark one"
    )
    trajectory: Trajectory | None = Field(
        default=None, description="the fitted path; absent where none is fitted"
    )
    protection: ProtectionLevels | None = Field(
        default=None, description="of the pose; absent where the session asked for none"
    )


class Contour(Message):
    """Contour points of the model at the pose of a frame, in pixels, for drawing."""

    points_px: list[Annotated[list[float], Field(min_length=2, max_length=2)]]
    kinds: list[int] = Field(description="0 outline, 1 step, 2 crease; one for each point")
    predicted: bool = Field(default=False, description="at the filter's pose: the frame gave none")


class WatchState(Message):
    """Text message to a watcher for each state that it is shown."""

    type: Literal["state"] = "state"
    state: State
    contour: Contour | None = Field(description="null without a pose or if not requested")
    silhouette_px: list[list[list[float]]] | None = Field(
        description="outlines found by the threshold, px; null if none or not requested"
    )
    image_follows: bool = Field(description="the next binary message is this frame's JPEG")
    sensors: list[SensorHealth]
    recording: Recording
    marks: list[Marks] = Field(description="from other sensors' newest lines of the last seconds")


class WatchEnd(Message):
    """The last text message to a watcher."""

    type: Literal["end"] = "end"
    reason: str


class History(Message):
    """States of the last minutes, oldest first, at most ``history_rate_hz`` per second."""

    session: str
    oldest_frame: int | None
    newest_frame: int | None
    states: list[State]
    images: list[int] = Field(description="frames whose JPEG is kept, in ascending order")
    events: list[Event] = Field(default=[], description="of a recording: phases, alarms, restarts")


class Event(Message):
    """Something that an operator should know, when it happened."""

    number: int = Field(description="in the session, from 0")
    unix_s: float
    level: Level
    kind: str = Field(
        description="phase, alarm, fusion, recording, worker, source, session, flight, operator"
    )
    text: str


class EventList(Message):
    """The events of a session, oldest first; the oldest are forgotten first."""

    events: list[Event]
