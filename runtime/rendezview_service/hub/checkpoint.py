"""What is kept of a session outside its process, so that another one can continue it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel, ConfigDict

from rendezview.errors import RendezviewError
from rendezview.io.file_lock import lock_if_possible
from rendezview.io.files import atomic_write_text, make_folder, write_error
from rendezview_service.hub.progress import Progress
from rendezview_service.messages.messages import SessionRequest

log = logging.getLogger("rendezview_service")

SUFFIX = ".session.json"
_WAIT_S = 0.25  # s, that an answer waits for the disk. Source: chosen


class Checkpoint(BaseModel):
    """A session after its last acknowledged frame."""

    model_config = ConfigDict(extra="forbid")

    request: SessionRequest
    model_sha256: str
    tracked: Progress
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


def kept_in(folder: Path) -> list[Checkpoint]:
    """All checkpoints of a folder; the log has the errors of those that cannot be read."""
    found = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        try:
            found.append(read_checkpoint(path))
        except (OSError, ValueError) as error:
            log.warning("checkpoint not read", extra={"path": str(path), "reason": str(error)})
    return [kept for kept in found if kept is not None]


def names_in(folder: Path) -> set[str]:
    """The sessions that have a checkpoint in a folder."""
    return {path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}")}


def lock_state(folder: Path) -> int:
    """Keep other services from a folder, as long as the descriptor that it returns is open.

    Raises:
        RendezviewError: another service has it, or it cannot be written to.
    """
    make_folder(folder)
    try:
        file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        ours = lock_if_possible(file)
    except OSError as error:
        raise write_error(folder, error) from error
    if ours is False:
        raise RendezviewError(f"{folder}: another service has its state there: choose another one")
    return file


class CheckpointKeeper:
    """Writes the checkpoints of one session, in a thread of its own: the newest one only.

    A disk that is slow or full delays one answer a little, and no more of any session until it
    works again.
    """

    _late: ClassVar[set[CheckpointKeeper]] = set()  # whose disk has kept an answer waiting

    def __init__(self, path: Path) -> None:
        """Nothing is written yet."""
        self._path = path
        self._change = threading.Condition()
        self._newest: Checkpoint | None = None  # that is not written yet
        self._asked = self._done = 0
        self._asked_s = 0.0  # when the oldest that is not written was asked for
        self._error: str | None = None
        self._ending = self._removing = False
        # Who waits for a checkpoint, by its number, each for a limited time. Of the event loop.
        self._waiting: dict[int, tuple[Callable[[], None], asyncio.TimerHandle]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def reason(self) -> str | None:
        """Why the newest checkpoint is not there; None: it is."""
        with self._change:
            waits_s = time.monotonic() - self._asked_s
            if self._done == self._asked or (self._error is None and waits_s < _WAIT_S):
                return self._error
            return self._error or f"{self._path}: the disk has not answered for {waits_s:.0f} s"

    def keep(self, checkpoint: Checkpoint, then: Callable[[], None] | None = None) -> None:
        """Replace the checkpoint.

        Args:
            then: is called by the running event loop when that is done; at once if the disk is
                late or failing already, and soon if it turns out to be late.
        """
        with self._change:
            if self._done == self._asked:
                self._asked_s = time.monotonic()
            self._newest = checkpoint
            self._asked += 1
            number, in_time = self._asked, self._error is None and not self._late
            self._change.notify_all()
        if then is not None and in_time:
            self._loop = asyncio.get_running_loop()
            timer = self._loop.call_later(_WAIT_S, self._is_late, number)
            self._waiting[number] = then, timer
            self._written(self._done)  # perhaps meanwhile, when nobody waited yet
        elif then is not None:
            then()

    def end(self, *, remove: bool = False) -> bool:
        """No other follows; whether all is done. If it is not yet, ask again.

        Args:
            remove: the session has ended, and its checkpoint goes.
        """
        with self._change:
            self._ending, self._removing = True, remove
            self._change.notify_all()
        self._thread.join(_WAIT_S)
        return self.is_ended

    @property
    def is_ended(self) -> bool:
        """Whether all is done."""
        return not self._thread.is_alive()

    def _written(self, number: int) -> None:
        """The checkpoints up to a number need no waiting any more."""
        for done in [one for one in self._waiting if one <= number]:
            then, timer = self._waiting.pop(done)
            timer.cancel()
            then()

    def _is_late(self, number: int) -> None:
        self._late.add(self)
        self._written(number)

    def _run(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._newest or self._ending)
                newest, asked, self._newest = self._newest, self._asked, None
            if self._removing:
                with contextlib.suppress(OSError):
                    self._path.unlink(missing_ok=True)
            if newest is None or self._removing:
                self._late.discard(self)
                return
            error = None
            try:
                write_checkpoint(self._path, newest)
            except (OSError, RendezviewError) as failed:
                error = str(failed)
            with self._change:
                self._done, self._error = asked, error
                self._asked_s = time.monotonic()
                self._late.discard(self)
                self._change.notify_all()
            if self._loop is not None:
                with contextlib.suppress(RuntimeError):  # it is closed: the service has ended
                    self._loop.call_soon_threadsafe(self._written, asked)
