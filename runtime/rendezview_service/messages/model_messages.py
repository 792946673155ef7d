"""Messages of models and of training jobs."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field

from rendezview_service.messages.message_parts import Message, Three


class Geometry(Message):
    """The model's data for a 3-D view: contour points and the view sphere (no mesh)."""

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
    spacing_m: float = Field(description="between the points; a dash of this length draws the edge")
    surface_m: list[Three] = Field(description="points of the surface; none in older models")
    normals: list[Three] = Field(description="unit, outwards, beside them")
    albedo: list[float] = Field(description="0 … 1, beside them")
    disc_m: float = Field(description="radius of discs at these points that cover the surface")


class ModelInfo(Message):
    """A view model of the service; only its name and the error, if it cannot be read."""

    name: str
    target: str | None = None
    sha256: str | None = None
    size_bytes: int | None = None
    order: int | None = None
    nodes: int | None = None
    target_radius_m: float | None = None
    sphere_radius_m: float | None = None
    refines: bool | None = None
    loaded: bool = Field(description="in memory")
    error: str | None = Field(default=None, description="why it cannot be read")


class ModelList(Message):
    """All models."""

    models: list[ModelInfo]


# Recordings


class Recorded(Message):
    """A log in the service's folder, with all its parts."""

    name: str
    session: str
    model: str = Field(description="its target")
    model_sha256: str
    camera: dict[str, Any] = Field(description="as `CameraMessage`")
    opened_unix_s: float | None = Field(description="of the session; null in older logs")
    began_unix_s: float | None
    length_s: float | None
    frames: int | None = Field(description="chunks: frames, and messages of other sensors")
    size_bytes: int
    parts: int
    recovered: bool


class RecordedList(Message):
    """All logs, the newest first."""

    recordings: list[Recorded]


# Training


class JobState(StrEnum):
    """State of a training job."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class JobInfo(Message):
    """A training job; it runs in its own process."""

    id: str
    model: str = Field(description="name that the model will have")
    state: JobState = JobState.QUEUED
    stage: str | None = Field(default=None, description="present stage")
    progress: float | None = Field(default=None, description="of the stage, 0 … 1")
    reason: str | None = Field(default=None, description="if it failed")
    warnings: list[str] = Field(default=[], description="what is odd about mesh and camera")
    created_unix_s: float
    elapsed_s: float | None = None


class JobList(Message):
    """All jobs, newest first."""

    jobs: list[JobInfo]
