"""What is kept of a session outside its process, so that another one can continue it."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from rendezview.io.files import atomic_write_text
from rendezview_service.messages.messages import SessionRequest

SUFFIX = ".session.json"


class Tracked(BaseModel):
    """What a session has tracked."""

    model_config = ConfigDict(extra="forbid")

    frames: int  # so far; the next one has this number
    found: int  # of them, with a pose
    last: str | None  # the last `State`, JSON
    last_unix_s: float | None = None  # when it was answered
    last_found: str | None  # the last one with a pose, JSON
    found_unix_s: float | None  # when it was found


class Checkpoint(BaseModel):
    """A session after its last acknowledged frame."""

    model_config = ConfigDict(extra="forbid")

    request: SessionRequest
    model_sha256: str
    tracked: Tracked
    log: str  # common to the parts of its log
    log_base: Path | None
    log_paths: list[Path]
    fused: bool  # other sensors have sent lines
    last_key: str | None = None  # of the last frame's request


def checkpoint_path(folder: Path, session: str) -> Path:
    """The file of a session."""
    return folder / f"{session}{SUFFIX}"


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Replace the file at once: a reader sees the old one or the new one.

    It is not forced to the disk: the end of a process does not lose it, loss of power can.

    Raises:
        RendezviewError: the folder is missing, the disk full, permission denied …
    """
    atomic_write_text(path, checkpoint.model_dump_json(), durable=False)


def read_checkpoint(path: Path) -> Checkpoint | None:
    """A session's checkpoint; None if it has none, so is not open."""
    try:
        return Checkpoint.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
