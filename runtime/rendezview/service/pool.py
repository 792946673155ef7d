"""The workers of the service, seen from the service: who tracks what, one frame at a time each.

Sessions of a worker that have a frame waiting, or a sensor's lines, take turns, so that none can
starve another.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from rendezview.service.wire import Header, Unpacker, mapped, pack, shared_memory

if TYPE_CHECKING:
    from rendezview.service.sessions import Session, Waiting

log = logging.getLogger("rendezview.service")

_START_S = 120.0  # a first start compiles


class WorkerGone(Exception):
    """The worker's process ended before it answered."""


class Worker(asyncio.Protocol):
    """One process that tracks."""

    def __init__(self, memory_bytes: int, frame_timeout_s: float) -> None:
        self._memory_bytes = memory_bytes
        self._frame_timeout_s = frame_timeout_s
        self.sessions: set[Session] = set()
        self.on_gone: Callable[[Worker], None] = lambda worker: None
        self.ready = False
        self._turns: deque[Session] = deque()  # with frames waiting
        self._current: tuple[Session, Waiting] | None = None
        self._answers: deque[tuple[str, asyncio.Future[Header]]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._transport: asyncio.Transport | None = None
        self._started: asyncio.Future[None] | None = None

    async def start(self) -> None:
        """Start the process and wait until it is ready.

        Raises:
            WorkerGone: it ended at once.
            TimeoutError: it did not say it is ready.
        """
        loop = asyncio.get_running_loop()
        ours, theirs = socket.socketpair()
        memory = shared_memory(self._memory_bytes)
        self._memory = mapped(memory, self._memory_bytes)
        self._unpacker = Unpacker()
        self._started = loop.create_future()
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "rendezview.service.worker"]
        self._process = subprocess.Popen(
            [*command, str(theirs.fileno()), str(memory), str(self._memory_bytes)],
            pass_fds=(theirs.fileno(), memory),
            stdin=subprocess.DEVNULL,
            env=environment,
        )
        theirs.close()
        os.close(memory)
        ours.setblocking(False)
        transport, _ = await loop.create_connection(lambda: self, sock=ours)
        self._transport = transport
        await asyncio.wait_for(self._started, _START_S)

    async def ask(self, header: Header) -> Header:
        """A request other than a frame or a measurement, and its answer.

        Raises:
            WorkerGone: there will be none.
        """
        if self._transport is None:
            raise WorkerGone
        future: asyncio.Future[Header] = asyncio.get_running_loop().create_future()
        self._answers.append((header["session"], future))
        self._transport.write(pack(header))
        return await future

    def wake(self, session: Session) -> None:
        """A session has a frame waiting."""
        if session not in self._turns:
            self._turns.append(session)
        self._next()

    def forget(self, session: Session) -> None:
        """A session is at its end."""
        self.sessions.discard(session)
        if session in self._turns:
            self._turns.remove(session)

    def stop(self) -> None:
        """Tell it to end; what it does is complete its logs."""
        self.on_gone = lambda worker: None
        if self._transport is not None:
            self._transport.write(pack({"kind": "quit"}))

    async def restart(self) -> None:
        """Another process in place of this one, which has no sessions yet."""
        gone, self.on_gone = self.on_gone, lambda worker: None
        if self._transport is not None:
            self._transport.write(pack({"kind": "quit"}))
        await self.join(_START_S)
        while self._transport is not None:
            await asyncio.sleep(0.01)
        self.on_gone = gone
        await self.start()

    async def join(self, timeout_s: float) -> None:
        """Wait for its end, at last kill it."""
        if self._process is None:
            return
        process = self._process
        try:
            await asyncio.wait_for(asyncio.to_thread(process.wait), timeout_s)
        except TimeoutError:
            process.kill()

    def _next(self) -> None:
        while self._current is None and self._turns and self._transport is not None:
            session = self._turns.popleft()
            waiting = session.take()
            if waiting is None:
                continue
            if session.has_waiting:
                self._turns.append(session)
            self._current = session, waiting
            place = 0
            for piece in waiting.pieces:
                self._memory[place : place + len(piece)] = piece
                place += len(piece)
            self._transport.write(pack(session.header_of(waiting)))
            loop = asyncio.get_running_loop()
            # Late lines are put where they belong, and what came after is said again for each.
            count = 1 if waiting.sensor is None else session.most_lines_of(waiting)
            self._timer = loop.call_later(count * self._frame_timeout_s, self._hung)

    def _done(self) -> None:
        self._current = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._next()

    def _hung(self) -> None:
        log.error("a worker hangs and is ended", extra={"timeout_s": self._frame_timeout_s})
        if self._process is not None:
            self._process.kill()

    # asyncio.Protocol

    def data_received(self, data: bytes) -> None:
        """Bytes of the worker."""
        for header, content in self._unpacker.feed(data):
            self._received(header, content)

    def _received(self, header: Header, content: bytes) -> None:
        kind = header["kind"]
        if kind == "ready":
            self.ready = True
            if self._started is not None and not self._started.done():
                self._started.set_result(None)
        elif kind in ("opened", "closed") or (
            kind == "fault" and header["of"] not in ("frame", "measure")
        ):
            self._answered(header)
        elif self._current is not None:
            session, waiting = self._current
            try:
                if kind == "state":
                    session.saw(waiting, header, content)
                elif kind == "extras":
                    session.saw_more(header, content)
                elif kind == "measured":
                    session.measured(waiting, header, content)
                else:
                    session.refused(waiting, header["error"], header.get("internal", False))
            finally:  # whatever happens, the next frame must not wait for ever
                if header.get("done", True):
                    self._done()

    def _answered(self, header: Header) -> None:
        for k, (session, future) in enumerate(self._answers):
            if session == header["session"]:
                del self._answers[k]
                if not future.done():
                    future.set_result(header)
                return

    def connection_lost(self, error: Exception | None) -> None:
        """The process is gone."""
        self.ready = False
        self._transport = None
        if self._started is not None and not self._started.done():
            self._started.set_exception(WorkerGone())
        for _, future in self._answers:
            if not future.done():
                future.set_exception(WorkerGone())
        self._answers.clear()
        if self._timer is not None:
            self._timer.cancel()
        if self._current is not None:
            session, waiting = self._current
            self._current = None
            session.broken(waiting)
        self._turns.clear()
        if self._process is not None:
            self._process.poll()
        self.on_gone(self)
