"""One worker process as the service sees it: its sessions take turns, one input at a time.

And what the service asks it for, beside frames and lines of sensors.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import mmap
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rendezview_service.hub.clock import PAUSE_S, Timer
from rendezview_service.hub.inputs import SessionInput
from rendezview_service.hub.sessions import Session
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.messages.wire import Header, Unpacker, pack, shared_memory
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import session_notes

log = logging.getLogger("rendezview_service")

_PATIENCE = 6.0  # × the limit of an input: for a process that waits for a processor. Source: chosen
# Ends of a process that its input brings about: its decoder took too long, or failed. Source: the
# limit of `decoding_time`, and the signals of faults (POSIX)
_OWN_FAULTS = (
    -signal.SIGPROF, -signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS, -signal.SIGFPE,
    -signal.SIGILL,
)  # fmt: skip
_END_S = 1.0  # s, from the end of a process's connection to its own. Source: chosen
_KEPT = 4_000_000  # bytes of shared memory that stay for the next input. Source: chosen
_GIVE_BACK: int | None = getattr(mmap, "MADV_REMOVE", None)  # absent on macOS
_START_S = 120.0  # s; the first start on a machine compiles. Source: a chosen limit
# s without an answer, in which a process must have worked for so long. Source: chosen limits
_IDLE_S, _LEAST_WORK_S = 60.0, 0.5


class WorkerGone(Exception):
    """The worker's process ended before it answered."""


class WorkerHandle(asyncio.Protocol):
    """Starts one worker process, sends it inputs, and gives its answers to the sessions."""

    def __init__(self, settings: Settings) -> None:
        self._settings, self._memory_bytes = settings, settings.frame_bytes
        self.sessions: set[Session] = set()
        self.on_gone: Callable[[WorkerHandle], None] = lambda worker: None
        self.on_progress: Callable[[int], None] = lambda loops: None  # compiled so far
        self.ready = False
        self._turns: deque[Session] = deque()  # sessions with an input waiting
        self._current: tuple[Session, SessionInput] | None = None
        self._asked = 0  # requests other than inputs, so far
        self._answers: dict[int, asyncio.Future[Header]] = {}  # to come, by the request's number
        self._timer: Timer | None = None
        self._sent_at_s = self._spent_before_s = 0.0  # of the input, its own processor's clock
        self._process: subprocess.Popen[bytes]  # from the start on
        self._killed = False  # by us: an input took too long
        self._transport: asyncio.Transport | None = None
        self._started: asyncio.Future[None] | None = None

    async def start(self) -> None:
        """Start the process and wait until it is ready.

        Raises:
            WorkerGone: it ended at once.
            TimeoutError: it is not ready in time.
        """
        loop = asyncio.get_running_loop()
        ours, theirs = socket.socketpair()
        memory = shared_memory(self._memory_bytes)
        self._memory = mmap.mmap(memory, self._memory_bytes)
        self._unpacker = Unpacker()
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "rendezview_service.worker.worker"]
        self._process = subprocess.Popen(
            [
                *command,
                str(theirs.fileno()),
                str(memory),
                str(self._memory_bytes),
                self._settings.model_dump_json(),
            ],
            pass_fds=(theirs.fileno(), memory),
            stdin=subprocess.DEVNULL,
            env=environment,
        )
        self._started = loop.create_future()
        theirs.close()
        os.close(memory)
        ours.setblocking(False)
        transport, _ = await loop.create_connection(lambda: self, sock=ours)
        self._transport = transport
        try:
            await asyncio.wait_for(self._started, _START_S)
        except TimeoutError:
            self._kill()
            raise

    async def ask(self, header: Header) -> Header:
        """A request other than an input, and its answer.

        Raises:
            WorkerGone: the process ended first, or hangs and is killed.
        """
        if self._transport is None:
            raise WorkerGone
        future: asyncio.Future[Header] = asyncio.get_running_loop().create_future()
        self._asked += 1
        self._answers[self._asked] = future
        self._transport.write(pack(header | {"number": self._asked}))
        while True:
            began_s, before_s = time.monotonic(), self._processor_s()
            try:
                return await asyncio.wait_for(asyncio.shield(future), _IDLE_S)
            except TimeoutError:  # compiling takes minutes, but works
                idle = sys.platform == "linux" and self._processor_s() - before_s < _LEAST_WORK_S
                # After a pause of this process, the answer may have come and is not read yet.
                if idle and time.monotonic() - began_s < _IDLE_S + PAUSE_S:
                    self._kill()
            except asyncio.CancelledError:
                future.cancel()
                raise

    def wake(self, session: Session) -> None:
        """A session has an input waiting."""
        if session not in self._turns:
            self._turns.append(session)
        self._next()

    def forget(self, session: Session) -> None:
        """A session has ended."""
        self.sessions.discard(session)
        if session in self._turns:
            self._turns.remove(session)

    def stop(self) -> None:
        """Ask the process to end; it completes its logs first."""
        self.on_gone = lambda worker: None
        if self._transport is not None:
            self._transport.write(pack({"kind": "quit"}))

    async def restart(self) -> None:
        """Replace the process, which has no sessions yet."""
        gone = self.on_gone
        self.stop()
        await self.join(_START_S)
        while self._transport is not None:
            await asyncio.sleep(0.01)
        self.on_gone = gone
        await self.start()

    async def join(self, timeout_s: float) -> None:
        """Wait until the process ends; kill it after the timeout."""
        if self._started is None:
            return
        try:
            await asyncio.wait_for(asyncio.to_thread(self._process.wait), timeout_s)
        except TimeoutError:
            self._kill()

    def _kill(self) -> None:
        """End the process. Its connection may outlive it, as long as a disk keeps one thread."""
        log.error("a worker does not answer and is killed")
        self._process.kill()
        if self._transport is not None:
            self._transport.abort()

    def _next(self) -> None:
        while self._current is None and self._turns and self._transport is not None:
            session = self._turns.popleft()
            waiting = session.waiting.take()
            if waiting is None:
                continue
            if session.waiting:
                self._turns.append(session)
            self._current = session, waiting
            request = session.header_of(waiting)
            # Every late line makes the filter repeat what came after it.
            most = self._settings.measurement_lines
            count = 1 if waiting.sensor is None else min(waiting.lines, most)
            waiting.move_to(self._memory)
            self._transport.write(pack(request))
            limit_s = count * self._settings.frame_timeout_s
            self._sent_at_s, self._spent_before_s = time.monotonic(), self._processor_s()
            self._timer = Timer(limit_s, partial(self._late, limit_s))

    def _done(self) -> None:
        if self._current is not None and self._current[1].length > _KEPT and _GIVE_BACK is not None:
            self._memory.madvise(_GIVE_BACK)
        self._current = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._next()

    def _late(self, limit_s: float) -> None:
        """An input takes long: kill the process, unless it only waits for a processor."""
        assert self._timer is not None
        left_s = limit_s - (self._processor_s() - self._spent_before_s)
        waited_s = time.monotonic() - self._sent_at_s - self._timer.paused_s
        if left_s > 0.01 and waited_s < _PATIENCE * limit_s and self._wants_processor:
            self._timer.start(left_s)
            return
        self._killed = True
        self._kill()

    def _exit_code(self) -> int | None:
        """How the process ended; None if it has not."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(_END_S)
        return None

    def _processor_s(self) -> float:
        """Processor time of the process so far; 0 where the system does not tell."""
        if sys.platform != "linux":
            return 0.0
        try:  # the clock of a process. Source: MAKE_PROCESS_CPUCLOCK of the kernel, kind 2
            return time.clock_gettime((~self._process.pid << 3) | 2)
        except OSError:
            return 0.0

    @property
    def _wants_processor(self) -> bool:
        """Whether the process could run, if it had a processor."""
        try:
            stat = Path(f"/proc/{self._process.pid}/stat").read_text()
            return stat.rpartition(")")[2].split()[0] == "R"
        except OSError:
            return False

    # asyncio.Protocol

    def data_received(self, data: bytes) -> None:
        """Bytes of the process."""
        for header, content in self._unpacker.feed(data):
            self._received(header, content)

    def _received(self, header: Header, content: bytes) -> None:
        kind = header["kind"]
        if kind == "ready":
            self.ready = True
            if self._started is not None and not self._started.done():
                self._started.set_result(None)
        elif kind == "progress":
            self.on_progress(header["loops"])
        elif header.get("to") is not None:
            future = self._answers.pop(header["to"], None)
            if future is not None and not future.done():
                future.set_result(header)
        elif kind == "recording":
            for session in self.sessions:
                if session.id == header["session"]:
                    session.recorded(header)
        elif self._current is not None:
            session, waiting = self._current
            try:  # after an error too, the input has its answer, and the next one its turn
                if kind == "state":
                    session.tracked(waiting, header, content)
                elif kind == "extras":
                    session.add_extras(header, content)
                elif kind == "measured":
                    session.measured(waiting, header, content)
                else:
                    session.refused(waiting, header["error"], header.get("internal", False))
            except Exception:
                log.exception("an answer of a worker failed")
                session.refused(waiting, "the service has an internal error: see its log", True)
            if header.get("done", True):
                self._done()

    def connection_lost(self, error: Exception | None) -> None:
        """The process has ended."""
        self.ready = False
        self._transport = None
        if self._started is not None and not self._started.done():
            self._started.set_exception(WorkerGone())
        for future in self._answers.values():
            if not future.done():
                future.set_exception(WorkerGone())
        self._answers.clear()
        if self._timer is not None:
            self._timer.cancel()
        if self._current is not None:
            session, waiting = self._current
            self._current = None
            session.lost(waiting, self._killed or self._exit_code() in _OWN_FAULTS)
        self._turns.clear()
        self._process.poll()
        self.on_gone(self)


def open_request(session: Session) -> Header:
    """Track a session from its next frame on, and record it if it has a log."""
    session_log, base = session.log, session.log.base
    notes = session_notes(
        session.id,
        session.request_now,
        session.stored.info.target or "?",
        session.stored.copy,
        model_file=session.stored.path.name,
        opened_unix_s=repr(session.created_unix_s),
        log=session_log.id,
        first_frame=str(session.frame_base),
        handover=json.dumps(session.handover),
        forgotten="yes" if session.is_fused else "no",
    )
    return {
        "kind": "open",
        "session": session.id,
        "notes": notes,
        "sight": sight_of(session.request, session.stored.copy),
        "log_path": None if base is None else str(base),
    }


def sight_of(request: SessionRequest, model: Path) -> Header:
    """What a session's recognizer is made for; the file of the model is named by its hash."""
    assert request.camera is not None
    camera = request.camera.model_dump(mode="json", exclude={"checked"})
    return {"camera": camera, "trees": request.trees, "model_path": str(model)}
