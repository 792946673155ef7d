"""The log of a session: `recorded` means written to the file that bears the log's name.

A thread of its own writes, so that a disk that is slow, full or gone delays no pose. States that
wait for it are pending. They, and those that no fsync has confirmed yet, stay in memory up to a
bound: whatever happens to a file, they go into the next one. A log has several files, its parts,
each complete in itself: a new one begins when the last is large or old enough, when another worker
continues the session, and after a fault. An open part is locked, so that nobody repairs or removes
it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import secrets
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rendezview.geometry.camera import Camera
from rendezview.io.files import write_error
from rendezview_service.logs import log_schemas
from rendezview_service.logs.log_folder import free_number, part_path
from rendezview_service.logs.log_part import Gone, OpenPart, Sync, beginning
from rendezview_service.logs.log_queue import Entry, Kept
from rendezview_service.messages.frames import Bytes
from rendezview_service.messages.messages import Recording, RecordingState
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import StateDict

log = logging.getLogger("rendezview_service.worker.worker")

RECORDED, PENDING = "recorded", "pending"
_CALIBRATION_EVERY_S = 1.0  # s, between messages with the camera. Source: chosen
_SYNC_EVERY_S = 1.0  # s, between fsyncs with `interval`. Source: chosen
_CHECK_EVERY_S = 0.5  # s, between looks at a file that nothing is written to. Source: chosen
_RETRY_S = 5.0  # s, before a new file is tried after two faults. Source: chosen
_LATE_S = 1.0  # s, that a state waits for the disk before that is a failure. Source: chosen
_LATE_SYNC_S = 5.0  # s, the same for an fsync. Source: chosen
_TOLD_S = 30.0  # s, for which a fault that is over is reported. Source: chosen


class LogWriter:
    """Writes the log of one session. Disk faults are reported in `status`, not raised.

    One thread uses it, the worker's; another one, its own, writes.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        metadata: Mapping[str, str],
        model: bytes | None,
        options: Settings,
    ) -> None:
        """Start a log, or its next part.

        Args:
            path: of its first part; if the file exists, the part gets the next number.
            metadata: the session's data for replay; ``log`` is common to the parts of a log.
            model: the model file, attached to each part.
            options: what is recorded, how long and large a part is, and when it is forced to disk.
        """
        self.options = options
        self._base = path
        self._camera, self._never_syncs = camera, self.options.sync == "never"
        self._metadata = {"log": secrets.token_hex(8)} | dict(metadata)
        self._model = model if self.options.record_images else None
        self._calibrated_at = -1e300
        # Both threads, under the condition:
        self._change = threading.Condition()
        self._kept = Kept(self.options.log_memory_bytes)
        self._part: OpenPart | None = None
        self._paths: list[Path] = []
        # The disk has kept an answer waiting: no other waits until it is done.
        self._late = self._ending = False
        self._reason: str | None = None  # why there is no part
        self._fault: str | None = None  # what last happened to a part
        self._fault_s = -math.inf
        self._faults = self._lost = self._messages = 0
        self._earlier_bytes = 0  # of the parts before
        self._sync_began_s: float | None = None
        # The own thread's:
        self._begun_s = self._synced_s = self._retry_s = 0.0
        self._number = 0  # of the last part that has anything in it
        self._tried = path  # the part that was last started
        self._syncing: threading.Thread | None = None
        self._unfinished: list[OpenPart] = []  # there was no room for their index
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"log {path.name}")
        with self._change:
            self._thread.start()
            self._change.wait_for(lambda: self._part or self._reason, self.options.log_wait_s)

    # The session's thread

    @property
    def status(self) -> Recording:
        """State of the log."""
        with self._change:
            reason, part, now_s = self._trouble(), self._part, time.monotonic()
            size = 0 if part is None else part.scan.end
            recent = self._fault is not None and now_s - self._fault_s < _TOLD_S
            return Recording(
                state=RecordingState.ON if reason is None else RecordingState.FAILED,
                reason=reason,
                name=self.path.name,
                messages=self._messages,
                size_bytes=size,
                parts=0 if part is None else part.number,
                all_bytes=self._earlier_bytes + size,
                lost=self._lost,
                pending=self._kept.waiting_states,
                faults=self._faults,
                fault=self._fault if recent else None,
            )

    @property
    def path(self) -> Path:
        """The file that is being written, or was last."""
        return self._paths[-1] if self._paths else self._base

    @property
    def paths(self) -> list[Path]:
        """All files that it has written, in order."""
        return list(self._paths)

    def write(self, state: StateDict, state_json: bytes, content: Bytes) -> str:
        """Record one frame: `RECORDED`, `PENDING` with a reason if known, or ``failed: …``."""
        calibrates = state["received_unix_s"] - self._calibrated_at >= _CALIBRATION_EVERY_S
        if calibrates:
            self._calibrated_at = state["received_unix_s"]
        picture = content if self.options.record_images else None
        found = log_schemas.of_frame(state, state_json, picture, self._camera, calibrates)
        return self._put(state["received_unix_s"], found)

    def write_measurements(self, lines: list[dict[str, Any]]) -> str:
        """Record lines of a sensor, each a `LoggedMeasurement`, all together; as `write`."""
        found = log_schemas.of_measurements(lines)
        return self._put(lines[0]["received_unix_s"], found, len(lines))

    def _put(self, log_s: float, found: list[log_schemas.Logged], states: int = 1) -> str:
        entry = Entry.of(log_s, found, self.options.compression, states)
        with self._change:
            if not self._kept.add(entry):
                self._lost += states
                return f"failed: {self._trouble() or 'the disk is too slow'}"
            self._change.notify_all()
            if not self._late:
                self._change.wait_for(
                    lambda: entry.recorded or self._reason, self.options.log_wait_s
                )
                self._late = not entry.recorded
            if entry.recorded:
                return RECORDED
            reason = self._trouble()
        return PENDING if reason is None else f"{PENDING}: {reason}"

    def end(self) -> None:
        """Nothing follows: begin to complete the log. `is_ended` reports that it is."""
        with self._change:
            self._ending = True
            self._change.notify_all()

    @property
    def is_ended(self) -> bool:
        """Whether nothing more is written."""
        return not self._thread.is_alive()

    def close(self, timeout_s: float | None = None) -> None:
        """Complete the log on the disk; what waits for longer (None: never) is lost."""
        self.end()
        self._thread.join(timeout_s)

    def _trouble(self) -> str | None:
        """Why states are not recorded at the moment, or may not stay so."""
        now_s, where = time.monotonic(), self.path.name
        if self._reason is not None:
            return self._reason
        oldest = self._kept.oldest
        if oldest is not None and now_s - oldest.put_s > _LATE_S:
            return f"{where}: the disk has not answered for {now_s - oldest.put_s:.0f} s"
        began_s = self._sync_began_s
        if began_s is not None and now_s - began_s > _LATE_SYNC_S:
            return f"{where}: the disk has confirmed nothing (fsync) for {now_s - began_s:.0f} s"
        return None

    # The writing thread

    def _run(self) -> None:
        while True:
            try:
                if not self._step():
                    break
            except Exception as error:  # this thread must not end silently
                log.exception("recording failed")
                self._broken(_of_disk(error))
        for part in self._unfinished:
            part.close()

    def _step(self) -> bool:
        """Write what waits; False: it was the last."""
        with self._change:
            self._change.wait_for(self._has_work, _CHECK_EVERY_S)
            part, ending = self._part, self._ending
            waiting = self._kept.waiting
        try:
            if part is None:
                if (ending and not waiting) or (time.monotonic() < self._retry_s and not ending):
                    return not ending
                part = self._open()
            if part.sync_error is not None:
                raise part.sync_error
            if waiting and self._is_long(part):
                part.check()
                self._finish(part)
                part = self._open()
            if waiting:
                part.append(waiting)
                if self.options.sync == "always":
                    self._sync(part, part.sync())
                self._recorded(part, waiting)
            else:
                part.check()
                if ending:
                    self._finish(part)
                    return False
            self._sync_sometimes(part)
        except OSError as error:
            self._broken(error)
            if ending and self._reason is not None:
                with self._change:
                    self._lost += self._kept.waiting_states
                return False
        return True

    def _has_work(self) -> bool:
        if self._ending or self._part is None:
            return self._ending or time.monotonic() >= self._retry_s
        return self._kept.oldest is not None or self._part.sync_error is not None

    def _is_long(self, part: OpenPart) -> bool:
        old = time.monotonic() - self._begun_s > self.options.log_part_s
        return part.states > 0 and (old or part.scan.end > self.options.log_part_bytes)

    def _recorded(self, part: OpenPart, entries: list[Entry]) -> None:
        with self._change:
            self._kept.written(len(entries))
            self._messages += sum(sum(entry.counts.values()) for entry in entries)
            self._kept.confirmed(part.scan.end if self._never_syncs else part.safe_end)
            self._late = self._late and self._kept.oldest is not None
            self._reason = None
            self._change.notify_all()

    def _sync(self, part: OpenPart, sync: Sync) -> None:
        """Run an fsync. Raises: OSError."""
        with self._change:
            self._sync_began_s = time.monotonic()
        try:
            sync.run()
        except Exception as error:  # whatever it is, nothing is confirmed
            part.sync_error = _of_disk(error)
            raise part.sync_error from error
        else:
            with self._change:
                part.confirm(sync)
                if part is self._part:
                    self._kept.confirmed(part.safe_end)
        finally:
            with self._change:
                self._sync_began_s = None
                self._change.notify_all()

    def _sync_sometimes(self, part: OpenPart) -> None:
        """Force the part to the disk, once a second, in a thread of its own."""
        now_s = time.monotonic()
        due = now_s - self._synced_s >= _SYNC_EVERY_S and self._sync_began_s is None
        if self.options.sync != "interval" or not due or part.scan.end == part.safe_end:
            return
        self._synced_s = self._sync_began_s = now_s
        sync = part.sync()

        def run() -> None:
            with contextlib.suppress(OSError):  # the next step finds it
                self._sync(part, sync)

        self._syncing = threading.Thread(target=run, daemon=True)
        self._syncing.start()

    def _open(self) -> OpenPart:
        """Start a part. Raises: OSError."""
        with contextlib.suppress(OSError):
            self._base.parent.mkdir(exist_ok=True)  # somebody has removed it
        number = free_number(self._base, self._number + 1)
        while True:
            notes = {"part": str(number), "continues": "yes" if self._number else "no"}
            head = beginning(self._metadata | notes, self._model)
            self._tried = part_path(self._base, number)
            try:
                part = OpenPart(self._tried, number, *head)
                break
            except FileExistsError:
                number = free_number(self._base, number + 1)
        if self.options.sync == "always":
            try:
                self._sync(part, part.sync())
            except OSError:
                part.remove()
                raise
        self._begun_s = self._synced_s = time.monotonic()
        self._calibrated_at = -1e300
        with self._change:
            self._part = part
            if self._kept.oldest is None:
                self._reason = None
            self._paths.append(part.path)
            self._change.notify_all()
        while self._unfinished and self._unfinished[-1].finish():
            self._unfinished.pop().close()
        return part

    def _finish(self, part: OpenPart) -> None:
        """End a part that is whole, on the disk. Raises: OSError of its fsync."""
        whole = part.finish()
        if self._syncing is not None:
            self._syncing.join()  # only one fsync of a file is given its error
        if part.sync_error is not None:
            raise part.sync_error
        if not self._never_syncs:
            self._sync(part, part.sync())
        self._leave(part)
        self._unfinished += [] if whole else [part]
        if whole:
            part.close()

    def _leave(self, part: OpenPart) -> None:
        with self._change:
            self._part = None
            self._number = part.number
            self._earlier_bytes += part.scan.end

    def _broken(self, error: OSError) -> None:
        """A part cannot be started, or the present one is gone or fails: another one follows."""
        part, now_s = self._part, time.monotonic()
        why = str(write_error(self._tried, error)) if part is None else self._given_up(part, error)
        with self._change:
            self._faults += part is not None or self._reason is None
            if part is None or now_s - self._fault_s < _RETRY_S:
                self._reason, self._retry_s = why, now_s + _RETRY_S
            self._fault, self._fault_s = why, now_s
            self._change.notify_all()

    def _given_up(self, part: OpenPart, error: OSError) -> str:
        """Leave a part. What is in memory of it goes into the next one; the reason."""
        why, there = str(write_error(part.path, error)), part.is_there
        whole = there and part.states > 0 and part.sync_error is None
        if isinstance(error, Gone):
            whole, why = whole and error.moved, f"{part.path}: {error.strerror}"
        if whole:
            try:
                self._finish(part)
                return why
            except OSError as of_sync:
                why = str(write_error(part.path, of_sync))
        if self._ending and there and part.sync_error is not None:  # nobody writes it again
            self._leave(part)
            part.close()
            return f"{why}; what is written stays as it is"
        with self._change:
            rescued = self._kept.put_back()
            lost = part.states - (part.safe_states if there else 0) - rescued
            self._lost += lost
            empty = there and not part.safe_states and not isinstance(error, Gone)
            if empty:
                self._part = None
                self._paths.remove(part.path)
            else:
                self._leave(part)
        (part.remove if empty else part.give_up)()  # a disk that hangs holds nobody else up
        return f"{why}; states lost with it: {lost}, written again from memory: {rescued}"


def _of_disk(error: Exception) -> OSError:
    """Any error as one of the disk."""
    return error if isinstance(error, OSError) else OSError(0, f"an internal error, {error!r}")
