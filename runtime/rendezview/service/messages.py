"""Every message of the service, checked: requests, answers, and what streams carry.

Field names carry units; frames and covariances are those of ``docs/conventions.md``. What
cannot be measured is ``null`` with a status and a reason beside it.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from rendezview.service.fusion_messages import Fused, FusionRequest, Marks
from rendezview.service.message_parts import Matrix6, Message, Name, PoseMessage, Three

# What a session is made of


class CameraMessage(Message):
    """A calibrated camera; pixel (0, 0) is the centre of the top-left pixel."""

    width: int = Field(ge=16, le=16384, description="px")
    height: int = Field(ge=16, le=16384, description="px")
    fx: FiniteFloat = Field(gt=0.0, le=1e7, description="px")
    fy: FiniteFloat = Field(gt=0.0, le=1e7, description="px")
    cx: FiniteFloat = Field(ge=-1e6, le=1e6, description="px")
    cy: FiniteFloat = Field(ge=-1e6, le=1e6, description="px")
    distortion: list[FiniteFloat] = Field(
        default=[], max_length=8, description="k1 k2 p1 p2 [k3 [k4 k5 k6]], OpenCV's order"
    )


class SessionRequest(Message):
    """A camera and a target to follow."""

    id: Name | None = Field(default=None, description="chosen by the service where absent")
    model: Name | None = Field(default=None, description="may be left out where there is one")
    camera: CameraMessage | None = Field(
        default=None, description="may be left out where the service was given one"
    )
    prior: PoseMessage | None = Field(
        default=None, description="of the first frame, attitude right to about 20°"
    )
    sun_camera: Three | None = Field(default=None, description="towards the Sun, camera frame")
    trees: bool = Field(default=True, description="ask for on nodes on every frame")
    record: bool | None = Field(default=None, description="default: as the service is set")
    fusion: FusionRequest | None = Field(
        default=None, description="what is known of other sensors; needed by ring and range alone"
    )


class Phase(StrEnum):
    """Where a session stands; what the operator sees first."""

    WAITING = "waiting"  # no frame yet
    TRACKING = "tracking"  # the last frame gave a pose
    COASTING = "coasting"  # not the last one, but one of the last few
    SEARCHING = "searching"  # no pose, and none of late: all attitudes are searched


class SensorHealth(Message):
    """One source of measurements of a session."""

    name: str
    kind: Literal["camera", "pose", "ring", "range"] = Field(
        description="the session's own camera, or what another sensor's lines hold"
    )
    healthy: bool
    reason: str | None = Field(description="why it is not healthy")
    frames: int = Field(description="looked at; of other sensors: lines")
    drops: int = Field(description="frames that a newer one replaced before they were looked at")
    rate_hz: float | None = Field(description="of the last seconds")
    last_unix_s: float | None = Field(description="when the last frame, or line, came")
    trust: SensorTrust | None = Field(
        default=None, description="of the filter; null: there is none"
    )


class SensorTrust(Message):
    """What the filter thinks of a sensor."""

    heard: int = Field(description="measurements")
    accepted: int
    silent: int = Field(description="lines, or poses, without a measurement")
    locked_out: bool
    lockouts: int
    mean_nis: float | None = Field(description="over degrees of freedom; 1 is as it should be")
    reason: str | None = Field(description="why the last one was not accepted")


class RecordingState(StrEnum):
    """Whether what is told is also kept."""

    OFF = "off"
    ON = "on"
    FAILED = "failed"  # the disk is full, say: tracking goes on


class Recording(Message):
    """The log of a session."""

    state: RecordingState
    reason: str | None = Field(default=None, description="of a failure")
    name: str | None = Field(default=None, description="of the file")
    messages: int = 0
    size_bytes: int = 0
    lost: int = Field(default=0, description="states and lines that could not be written")


class SessionInfo(Message):
    """A session as it stands."""

    id: str
    model: str
    camera: CameraMessage
    source: str | None = Field(description="what the service itself reads; null: frames are sent")
    phase: Phase
    created_unix_s: float
    frames: int
    drops: int
    found_fraction: float | None = Field(description="share of the frames that gave a pose")
    watchers: int
    last_frame: int | None
    last_time_s: float | None
    since_pose_s: float | None = Field(description="frame time since the last pose")
    sensors: list[SensorHealth]
    recording: Recording
    finished: bool = Field(description="a source that has come to its end, or has failed")
    reason: str | None = Field(default=None, description="why a source ended, if by an error")


class SessionList(Message):
    """All sessions."""

    sessions: list[SessionInfo]


# What a frame gives


class Rates(Message):
    """How the target moves in the camera frame, from the last two poses."""

    angular_rad_s: Three
    linear_m_s: Three = Field(description="of the view centre")


class OnNode(Message):
    """A node of the sphere of views that recognised the frame."""

    index: int
    weight: float
    direction: Three = Field(description="unit, target frame, from the view centre to the camera")


class Fit(Message):
    """How the best refined pose stands on the frame, given or not."""

    outline: float = Field(description="share of the outline's edges where the pose puts them")
    inner: float = Field(description="the same of creases and steps")
    seen: float = Field(description="share of the outline in the picture")
    residual_px: float
    margin: float = Field(description="merit above the best other pose")


class State(Message):
    """What one frame gave. Without a pose there are a status and a reason."""

    session: str
    frame: int = Field(description="of the session, counted from 0 over looked-at frames")
    time_s: float = Field(description="of the frame, as its sender says")
    received_unix_s: float
    phase: Phase
    status: str = Field(description="ok, empty, full, border, small, rivals, … as in `track`")
    reason: str | None
    pose: PoseMessage | None = Field(description="camera_from_target")
    covariance: Matrix6 | None = Field(
        description="rotation vector (rad), translation (m); camera frame, perturbation left"
    )
    confidence: float | None
    score: float
    range_m: float | None = Field(description="of the view centre")
    rates: Rates | None
    candidates: list[PoseMessage] = Field(description="poses that fit but are not given")
    fit: Fit | None
    active_nodes: list[OnNode]
    stage_ms: dict[str, float]
    track_ms: float = Field(description="of the tracker, all stages")
    latency_ms: float = Field(description="from the frame's arrival to this answer")
    drops: int = Field(description="frames of the session that newer ones replaced, so far")
    recorded: bool = Field(description="this state is in the log")
    fused: Fused | None = Field(
        default=None, description="by all sensors; absent while the camera is the only one"
    )


class Contour(Message):
    """Contour points of the view model at the pose of a frame, pixels; for drawing."""

    points_px: list[Annotated[list[float], Field(min_length=2, max_length=2)]]
    kinds: list[int] = Field(description="0 outline, 1 step, 2 crease; one for each point")


class WatchState(Message):
    """What a watcher gets, as a text message, for each state it is shown."""

    type: Literal["state"] = "state"
    state: State
    contour: Contour | None = Field(description="null without a pose, or if not asked for")
    silhouette_px: list[list[list[float]]] | None = Field(
        description="outlines that the threshold found, pixels; null if not asked for or none"
    )
    image_follows: bool = Field(description="the next binary message is this frame's JPEG")
    sensors: list[SensorHealth]
    recording: Recording
    marks: list[Marks] = Field(description="of other sensors' newest lines, if of the last seconds")


class WatchEnd(Message):
    """The last text message a watcher gets."""

    type: Literal["end"] = "end"
    reason: str


class History(Message):
    """States of the last minutes, oldest first; at most ``history_rate_hz`` a second are kept."""

    session: str
    oldest_frame: int | None
    newest_frame: int | None
    states: list[State]
    images: list[int] = Field(description="frames whose JPEG is kept, rising")


# What the page draws in space


class Geometry(Message):
    """A target as the model knows it: no mesh, but contour points and the sphere of views."""

    model: str
    target_radius_m: float
    sphere_radius_m: float
    centre_m: Three = Field(description="view centre, target frame")
    nodes: list[Three] = Field(description="unit directions of the nodes, target frame")
    edges: list[Annotated[list[int], Field(min_length=2, max_length=2)]] = Field(
        description="pairs of neighbouring nodes"
    )
    points_m: list[Three] = Field(description="contour points, target frame, thinned")
    tangents: list[Three] = Field(description="unit, along the edge at each point")
    kinds: list[int] = Field(description="0 outline, 1 step, 2 crease; one for each point")
    spacing_m: float = Field(description="of the points: a dash of that length draws the edge")


class ModelInfo(Message):
    """A view model that the service has."""

    name: str
    target: str
    sha256: str
    size_bytes: int
    order: int
    nodes: int
    target_radius_m: float
    sphere_radius_m: float
    refines: bool
    loaded: bool = Field(description="in memory, because a session has used it")


class ModelList(Message):
    """All models."""

    models: list[ModelInfo]


# Training


class JobState(StrEnum):
    """Of a training job."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class JobInfo(Message):
    """A training job, which runs in a process of its own."""

    id: str
    model: str = Field(description="name that the model will have")
    state: JobState
    stage: str | None = Field(description="what is being done")
    progress: float | None = Field(description="of the stage, 0 … 1")
    reason: str | None = Field(description="of a failure")
    created_unix_s: float
    elapsed_s: float | None


class JobList(Message):
    """All jobs, newest first."""

    jobs: list[JobInfo]


# The field's own types: ROS geometry_msgs, field for field


class Stamp(Message):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Message):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Xyz(Message):
    """geometry_msgs/Point and Vector3."""

    x: float
    y: float
    z: float


class Quaternion(Message):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class RosPose(Message):
    """geometry_msgs/Pose."""

    position: Xyz
    orientation: Quaternion


class RosPoseWithCovariance(Message):
    """geometry_msgs/PoseWithCovariance."""

    pose: RosPose
    covariance: list[float] = Field(
        min_length=36, max_length=36, description="row-wise; x, y, z, then rotation about x, y, z"
    )


class PoseWithCovarianceStamped(Message):
    """geometry_msgs/PoseWithCovarianceStamped: the target in the camera frame."""

    header: Header
    pose: RosPoseWithCovariance


class Transform(Message):
    """geometry_msgs/Transform."""

    translation: Xyz
    rotation: Quaternion


class TransformStamped(Message):
    """geometry_msgs/TransformStamped: camera to target."""

    header: Header
    child_frame_id: str
    transform: Transform


# Operations


class Health(Message):
    """``/healthz`` and ``/readyz``."""

    status: Literal["ok", "not ready", "stopping"]
    reasons: list[str] = Field(default=[])
    version: str
    uptime_s: float
    sessions: int
    recording_failures: int


class Fault(Message):
    """The body of every answer with a status of 400 or more."""

    error: str = Field(description="what is wrong, where, and what to do")
    status: int
