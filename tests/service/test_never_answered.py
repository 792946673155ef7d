"""What comes after the end, or waits for something that hangs, has its answer in the end."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, ClassVar
from urllib.parse import urlsplit

import httpx
import pytest
from tests.service.logged import settings_of
from tests.waiting import MOST_S, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.client import ServiceError
from rendezview_service.http import streams
from rendezview_service.hub import child_program, source_process, worker_handle
from rendezview_service.hub.inputs import Answer, InputQueue, NotReady, SessionInput
from rendezview_service.hub.metrics import Metrics
from rendezview_service.hub.source_process import SourceProcess
from rendezview_service.hub.watching import Watcher, Watchers
from rendezview_service.hub.worker_handle import WorkerGone, WorkerHandle
from rendezview_service.hub.worker_pool import WorkerPool
from rendezview_service.logs.recording import PENDING, RECORDED, LogWriter
from rendezview_service.messages.wire import Unpacker, pack, receive, shared_memory
from rendezview_service.settings import Settings

# One of the threads for the disk waits for ever.
HUNG_THREAD = """
import asyncio, threading
to_thread = asyncio.to_thread
async def hangs(work, *arguments, **more):
    if getattr(work, "__name__", "") == "first_readable":
        asyncio.get_running_loop().run_in_executor(None, threading.Event().wait)
    return await to_thread(work, *arguments, **more)
asyncio.to_thread = hangs
"""


@contextlib.contextmanager
def asleep(before: str = "") -> Iterator[subprocess.Popen[bytes]]:
    program = f"import time\n{before}\nprint(flush=True)\ntime.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process
        finally:
            process.kill()


def test_a_frame_whose_body_arrives_when_its_session_has_ended_is_refused(client, camera, tour):
    session, parts = client.open(camera), urlsplit(client.stream_url("x", "y"))
    grey = tour[0][2].tobytes()
    place = parts.hostname or "", parts.port or 0
    with socket.create_connection(place, timeout=MOST_S) as slow:
        head = f"POST /v1/sessions/{session.name}/frames HTTP/1.1\r\nHost: {parts.hostname}\r\n"
        slow.sendall(f"{head}Content-Length: {len(grey)}\r\n\r\n".encode() + grey[:1000])
        wait_until(lambda: client.request("GET", "/healthz")["budgets"]["bodies_bytes"]["used"])
        session.close()
        slow.sendall(grey[1000:])
        assert b" 410 " in slow.recv(100)


def test_a_queue_that_is_closed_answers_at_once() -> None:
    answers: list[Answer] = []
    queue = InputQueue()

    def frame() -> SessionInput:
        return SessionInput([b"x"], 0.0, 0.0, 0.0, answers.append)

    queue.append(frame())
    queue.replace(frame())
    end = Answer(410, b"", "it has ended", ends=True)
    queue.close(end)
    queue.append(frame())
    assert queue.replace(frame()) is None
    with queue.streaming(answers.append):  # its session was found before the end
        assert answers == [end] * 5
    assert not queue


def test_a_stream_that_only_receives_is_told_that_its_session_has_ended(client, camera):
    session = client.open(camera)
    with session.stream() as stream:
        session.close()
        with pytest.raises(ServiceError, match="closed by a request") as told:
            stream.receive(MOST_S)
        assert told.value.status == 410
        with pytest.raises(RendezviewError, match="the stream has ended"):
            stream.receive(MOST_S)


def test_a_watcher_that_comes_after_the_end_is_told() -> None:
    watchers = Watchers(lambda: None)
    watchers.end("it has ended")
    late = Watcher(1.0, 0, contour=False, silhouette=False)
    watchers.add(late)
    assert late.ended == "it has ended"
    assert late.news.is_set()


def test_a_stream_that_is_cut_off_with_its_answers_unread_is_over(monkeypatch) -> None:
    """The service waits for room among these answers, and nobody reads them any more."""

    class Cut:
        headers: ClassVar = {"X-Sender": "somebody"}
        scope: ClassVar = {}
        sent = 0

        async def receive(self) -> dict[str, Any]:
            return {"type": "websocket.receive", "bytes": b"short"}

        async def send(self, message: object) -> None:
            self.sent += 1
            raise RuntimeError("it is closed")

    async def accepted(*_: object) -> Any:
        lease = SimpleNamespace(release=lambda sender: None)
        return SimpleNamespace(lease=lease, waiting=InputQueue())

    monkeypatch.setattr(streams, "_accepted", accepted)
    cut: Any = Cut()
    asyncio.run(asyncio.wait_for(streams.stream(cut, "s"), 30.0))
    assert cut.sent == 1


class _Handled:
    """A handle with a connection whose other end this process has."""

    def __init__(self, process: Any) -> None:
        self.handle: WorkerHandle = WorkerHandle(Settings(frame_bytes=4096, frame_timeout_s=5.0))
        self.handle._process, self.handle._unpacker = process, Unpacker()
        self.gone: list[Any] = []
        self.handle.on_gone = self.gone.append

    async def connect(self) -> socket.socket:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_connection(lambda: self.handle, sock=ours)
        self.handle._transport = transport
        return theirs


def test_a_worker_that_hangs_over_another_request_is_killed(monkeypatch) -> None:
    """Its connection stays open, as where a disk keeps one of its threads."""
    monkeypatch.setattr(worker_handle, "_IDLE_S", 0.3)
    with asleep() as process:
        known = _Handled(process)

        async def ask() -> None:
            theirs = await known.connect()
            with pytest.raises(WorkerGone):
                await known.handle.ask({"kind": "open", "session": "s"})
            theirs.close()

        asyncio.run(asyncio.wait_for(ask(), MOST_S))
        assert process.wait(MOST_S) == -signal.SIGKILL
    assert known.gone == [known.handle]


def _compiled_after(known: _Handled, before_s: float, pause_s: float) -> Any:
    """The answer to a request, which comes after a time; and then a pause of this process."""

    async def ask() -> Any:
        theirs = await known.connect()
        asked = asyncio.create_task(known.handle.ask({"kind": "warm"}))
        await asyncio.sleep(before_s)
        theirs.sendall(pack({"kind": "done", "to": 1, "compiled": 3}))
        time.sleep(pause_s)
        answer = await asked
        theirs.close()
        return answer["compiled"]

    return asyncio.run(ask())


def test_a_worker_that_works_for_long_is_waited_for(monkeypatch) -> None:
    monkeypatch.setattr(worker_handle, "_IDLE_S", 0.2)
    known = _Handled(SimpleNamespace(kill=lambda: pytest.fail("killed"), pid=0))
    spent = iter(range(1000))
    monkeypatch.setattr(WorkerHandle, "_processor_s", lambda self: float(next(spent)))
    assert _compiled_after(known, 0.7, 0.0) == 3


def test_after_a_pause_of_the_service_an_answer_is_read_before_its_worker_is_judged(monkeypatch):
    monkeypatch.setattr(worker_handle, "_IDLE_S", 0.3)
    known = _Handled(SimpleNamespace(kill=lambda: pytest.fail("killed"), pid=0))
    monkeypatch.setattr(WorkerHandle, "_processor_s", lambda self: 0.0)
    assert _compiled_after(known, 0.01, 1.5) == 3  # the timer is due, and the answer is not read


def test_an_answer_that_the_service_cannot_take_refuses_its_input() -> None:
    refused: list[str] = []

    def fails(*_: object) -> None:
        raise ValueError("a state that is none")

    session = SimpleNamespace(tracked=fails, refused=lambda _, why, internal: refused.append(why))
    handle: WorkerHandle = WorkerHandle(Settings(frame_bytes=4096, frame_timeout_s=5.0))
    handle._current = session, SimpleNamespace(length=1)
    handle._received({"kind": "state"}, b"")
    assert refused == ["the service has an internal error: see its log"]
    assert handle._current is None  # the next one has its turn


def test_a_worker_of_a_service_with_a_thousand_connections_starts() -> None:
    most = 1500
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard <= most:
        pytest.skip(f"this machine has at most {hard} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most + 1), hard))
    ours, theirs = socket.socketpair()
    memory = shared_memory(4096)
    os.dup2(theirs.fileno(), most)
    command = [sys.executable, "-m", "rendezview_service.worker.worker", str(most), str(memory)]
    process = subprocess.Popen(
        [*command, "4096", Settings().model_dump_json()], pass_fds=(most, memory)
    )
    try:
        for file in (most, memory):
            os.close(file)
        theirs.close()
        ours.settimeout(MOST_S)
        assert receive(ours) == ({"kind": "ready"}, b"")
        ours.sendall(pack({"kind": "close", "session": "none", "number": 7}))
        assert receive(ours) == ({"kind": "done", "to": 7}, b"")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        ours.close()
        process.kill()
        process.wait(MOST_S)


def test_a_decoder_that_does_not_end_is_ended(monkeypatch) -> None:
    monkeypatch.setattr(source_process, "_END_S", 0.2)
    reader = SourceProcess.__new__(SourceProcess)
    with asleep() as reader._process:
        assert reader._end() == "its decoder did not answer"


def test_a_program_that_does_not_end_is_killed() -> None:
    deaf = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    with asleep(deaf) as process:
        child_program.end(process, 0.2)
        assert process.wait(MOST_S) == -signal.SIGKILL


def test_a_service_ends_though_a_thread_waits_for_a_disk(start_service) -> None:
    served = start_service(given=False, before=HUNG_THREAD)
    assert httpx.get(served.url + "healthz", timeout=MOST_S).status_code == 200
    served.process.send_signal(signal.SIGTERM)
    assert served.process.wait(60.0) == 0


def test_a_disk_that_hangs_while_a_part_is_given_up_holds_up_nobody(tmp_path, camera, monkeypatch):
    """Tracking needs the lock that the writing thread would hold."""
    cuts, cut, truncate = threading.Event(), threading.Event(), os.ftruncate
    fsync, fails = os.fsync, iter([False, False, False, True])

    def fails_once(file: int) -> None:
        if next(fails, False):
            raise OSError(errno.EIO, "Input/output error")
        fsync(file)

    def hangs(file: int, length: int) -> None:
        cuts.set()
        cut.wait(MOST_S)
        truncate(file, length)

    def write(k: int) -> str:
        state = {"frame": k, "time_s": 0.1 * k, "received_unix_s": 1.7e9 + k, "pose": None}
        return writer.write(state, json.dumps(state).encode(), b"picture")

    monkeypatch.setattr(os, "fsync", fails_once)
    monkeypatch.setattr(os, "ftruncate", hangs)
    options = settings_of(sync="always", log_wait_s=MOST_S)
    writer = LogWriter(tmp_path / "run.mcap", camera, {}, None, options)
    assert write(0) == RECORDED  # fsync of the part and its folder, and of the state
    writer.options = settings_of(sync="always", log_wait_s=0.05)
    try:
        assert write(1).startswith(PENDING)
        assert cuts.wait(MOST_S)
        before_s = time.monotonic()
        assert write(2).startswith(PENDING)
        assert writer.status.pending == 2
        assert time.monotonic() - before_s < 0.1 * MOST_S
    finally:
        cut.set()
    wait_until(lambda: writer.status.pending == 0)
    writer.close(MOST_S)


def test_a_session_with_own_sensors_waits_for_their_loops_or_is_told_to_come_later() -> None:
    answers = iter([True, False, True])
    pool = WorkerPool(Settings(), Metrics(), SimpleNamespace())
    asyncio.run(pool.sensors_compiled(0.0))  # nothing is compiled beside
    pool.without_sensors = lambda: next(answers)
    asyncio.run(pool.sensors_compiled(None))
    with pytest.raises(NotReady, match="being compiled"):
        asyncio.run(pool.sensors_compiled(0.0))
