"""What is kept of a session outside its process, so that another one can continue it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from rendezview.io.files import atomic_write_text
from rendezview.service.approach_messages import Level
from rendezview.service.messages import SessionRequest

if TYPE_CHECKING:
    from rendezview.service.sessions import Session

SUFFIX = ".session.json"


class Checkpoint(BaseModel):
    """A session after its last acknowledged frame."""

    model_config = ConfigDict(extra="forbid")

    request: SessionRequest
    model_sha256: str
    frames: int  # tracked so far; the next one has this number
    last: str | None  # the last `State`, JSON
    last_found: str | None  # the last one with a pose, JSON
    found_unix_s: float | None  # when it was found
    log: str  # common to the parts of its log
    log_base: Path | None
    log_paths: list[Path]
    fused: bool  # other sensors have sent lines


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


def checkpoint_of(session: Session) -> Checkpoint:
    """What another service needs to continue a session."""
    last, found = session.last, session._last_found
    age_s = time.monotonic() - session._found_at_s
    return Checkpoint(
        request=session.request,
        model_sha256=session.stored.sha256,
        frames=session._frames,
        last=None if last is None else last.decode(),
        last_found=None if found is None else found.decode(),
        found_unix_s=None if found is None else time.time() - age_s,
        log=session.log.id,
        log_base=session.log.base,
        log_paths=[part.path for part in session.log.parts],
        fused=session.is_fused or session.was_fused,
    )


def resume(session: Session, checkpoint: Checkpoint) -> None:
    """Continue a session of another service; the tracker starts at its last pose."""
    session._frames, session.was_fused = checkpoint.frames, checkpoint.fused
    if checkpoint.last is not None:
        session.last = checkpoint.last.encode()
    if checkpoint.last_found is not None and checkpoint.found_unix_s is not None:
        session._last_found = checkpoint.last_found.encode()
        session._found_at_s = time.monotonic() - max(0.0, time.time() - checkpoint.found_unix_s)
    session.log.resume(checkpoint.log, checkpoint.log_base, checkpoint.log_paths)
    session.events.add("node", Level.WARNING, "another node continues the session")
    session.reopened()
