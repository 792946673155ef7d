"""What one client, model, clock or sender must not do to the others."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from tests.waiting import MOST_S, ends_in_time, wait_until

from rendezview_service.client import ServiceError
from rendezview_service.hub.clock import SessionClock, Timer
from rendezview_service.hub.inputs import Lease, Taken
from rendezview_service.hub.worker_handle import WorkerHandle
from rendezview_service.logs.replay import model_of, read_log
from rendezview_service.settings import Settings

# Runs before the service: `time.time` is off by what the file says.
CLOCK = """
import os, time
_time, _path = time.time, os.environ["CLOCK_OFF_BY"]
def time_with_steps():
    try:
        return _time() + float(open(_path).read() or 0)
    except OSError:
        return _time()
time.time = time_with_steps
"""

# A decoder that never ends, for one file; and who is barred for it stays so, however slow this is.
SLOW_DECODER = """
import sys
if "serve" in sys.orig_argv:
    import rendezview_service.hub.inputs as inputs
    inputs._BARRED_S = 6000.0
if "rendezview_service.worker.worker" in sys.orig_argv:
    import rendezview.io.sequences.decoding as decoding
    import rendezview_service.messages.frames as frames
    real = frames.read_frame
    def read_frame(content, camera):
        while bytes(content[:7]) == b"\\xff\\xd8\\xffslow":
            pass
        return real(content, camera)
    frames.read_frame = read_frame
"""


def test_a_model_that_is_sent_again_is_used_and_logged(
    service, client, refining_model, camera, tour, tmp_path
):
    """Under one name; a session that is open keeps its own."""
    bigger = replace(refining_model, name="bigger", provenance={"why": "other content"})
    paths = [tmp_path / name for name in ("first.rvm", "second.rvm")]
    for path, model in zip(paths, (refining_model, bigger), strict=True):
        model.save(path)
    hashes = []
    kept = None
    for path in paths:
        content = path.read_bytes()
        answer = httpx.put(
            f"{service.url}v1/models/sat?replace=true", content=content, timeout=MOST_S
        )
        assert answer.status_code == 201, answer.text
        session = client.open(camera, model="sat", prior=tour[0][1])
        state = session.track(tour[0][2], 0.0)
        assert state["pose"] is not None
        assert state["model_sha256"] == session.info()["model_sha256"]
        assert state["model_sha256"] == answer.json()["sha256"]
        hashes.append(state["model_sha256"])
        session.close()
        log = read_log(max(service.folder.glob("s-*.mcap"), key=lambda log: log.stat().st_mtime))
        assert log.notes["model_sha256"] == hashes[-1]
        assert model_of(log, None).name == ("bumpy" if path == paths[0] else "bigger")
        if kept is None:
            kept = client.open(camera, model="sat", prior=tour[0][1])
    assert len(set(hashes)) == 2
    assert kept.track(tour[0][2], 0.0)["model_sha256"] == hashes[0]  # it keeps its own
    with pytest.raises(ServiceError, match="there is one already"):
        client.send_model("sat", paths[0])
    kept.close()
    client.request("DELETE", "/v1/models/sat")


@pytest.fixture(scope="module")
def stepped(start_service, tmp_path_factory):
    """A service whose clock the file ``off_by`` sets, and where a sender keeps its session."""
    folder = tmp_path_factory.mktemp("stepped")
    (folder / "off_by").write_text("0")
    served = start_service(
        before=CLOCK,
        CLOCK_OFF_BY=str(folder / "off_by"),
        RENDEZVIEW_SERVE_SENDER_HOLD_S=str(MOST_S),
    )
    served.folder = folder
    yield served
    served.stop()


def test_a_step_of_the_clock_does_not_reach_a_session(stepped, camera, tour):
    served, off_by = stepped, stepped.folder / "off_by"
    off_by.write_text("0")
    with served.client() as client:
        session = client.open(camera, prior=tour[0][1])
        states, start_s = [], time.monotonic()
        for step_s in ("0", "7200", "0", "-7200"):
            off_by.write_text(step_s)
            states += [session.track(image) for _, _, image in tour[:2]]  # without a time
        times_s = [state["time_s"] for state in states]
        assert times_s == sorted(set(times_s))
        assert times_s[-1] - times_s[0] <= time.monotonic() - start_s
        # A sender whose own clock steps back is told, and so is who looks after the service.
        later_s = times_s[-1] + 3000.0
        session.track(tour[2][2], later_s)

        def degraded() -> list[str]:
            with pytest.raises(ServiceError, match="order of time"):
                session.track(tour[2][2], later_s - 7200.0)
            health = client.request("GET", "/healthz")
            return health["reasons"] if health["status"] == "degraded" else []

        assert "order of time" in wait_until(degraded)[0]
        session.track(tour[2][2], later_s + 1.0)
        assert client.request("GET", "/healthz")["status"] == "ok"
        session.close()
    off_by.write_text("0")


def test_the_clock_of_a_session_goes_on_from_its_start(monkeypatch):
    clock = SessionClock.started_now()
    start_s = time.monotonic()
    before = clock.unix_s(start_s)
    assert before == pytest.approx(time.time(), abs=MOST_S)
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert clock.unix_s(start_s + 1.5) - before == pytest.approx(1.5, abs=1e-6)


def test_a_lease_is_held_renewed_and_let_go():
    lease = Lease(2.0)
    lease.take("a", 10.0)
    lease.take("a", 11.5)
    with pytest.raises(Taken, match="2 s"):
        lease.take("b", 13.0)
    lease.take("b", 14.0)
    lease.release("a")
    with pytest.raises(Taken):
        lease.take("a", 14.5)
    lease.release("b")
    lease.take("a", 14.6)


@pytest.mark.requirement("RV-SVC-3")
def test_two_senders_do_not_mix(stepped, camera, tour):
    """The other one's frames show the target elsewhere: its attitude would jump."""
    served = stepped
    refused = []
    with (
        served.client() as client,
        served.client() as other,
        client.open(camera, prior=tour[0][1], name="shared") as session,
        session.stream() as first,
    ):
        first.send(tour[0][2], 0.0)
        states = [first.receive(MOST_S)]
        second = other.session("shared")
        with second.stream() as stream:
            for k in range(1, 6):
                first.send(tour[k][2], float(k))
                stream.send(tour[-k][2], k + 0.5)
                states.append(first.receive(MOST_S))
                with pytest.raises(ServiceError, match="another sender") as conflict:
                    stream.receive(MOST_S)
                refused.append(conflict.value.status)
        with pytest.raises(ServiceError, match="another sender"):
            second.track(tour[0][2], 100.0)
        assert [state["time_s"] for state in states] == [float(k) for k in range(6)]
        assert refused == [409] * 5
        first.close()  # it lets go

        def taken_over() -> dict | None:
            with contextlib.suppress(ServiceError):
                return second.track(tour[6][2], 101.0)
            return None

        assert wait_until(taken_over)["status"] == "ok"


@pytest.fixture(scope="module")
def hurried(start_service, tmp_path_factory):
    """An input may take 3 s; with a spare worker, a decoder that never ends, and logs."""
    folder = tmp_path_factory.mktemp("hurried")
    served = start_service(
        "--record", str(folder / "logs"),
        before=SLOW_DECODER, RENDEZVIEW_SERVE_SPARE_WORKER="true",
        RENDEZVIEW_SERVE_FRAME_TIMEOUT_S="3",
    )  # fmt: skip
    served.folder = folder / "logs"
    yield served
    served.stop()


def _restarts(client) -> float:
    (count,) = re.findall(rb"^rendezview_worker_restarts_total (.*)$", _metrics(client), re.M)
    return float(count)


def _metrics(client) -> bytes:
    return client.fetch("GET", "/metrics")


def test_a_decoder_that_takes_long_ends_its_process_and_bars_its_session_but_no_other(
    hurried, camera, tour
):
    """A decoder that never ends stands for the file that nobody knows yet."""
    served = hurried
    with served.client() as client, served.client() as other:
        restarts = _restarts(client)
        session = client.open(camera, prior=tour[0][1], name="mine")
        attacker = other.open(camera, name="theirs")
        states = [session.track(tour[k][2], float(k)) for k in range(3)]
        served.await_line("a spare worker is ready")
        (first,) = _writers(served, session)
        (spare,) = set(served.workers) - {first}

        def attack() -> None:
            with contextlib.suppress(ServiceError):
                attacker.track(b"\xff\xd8\xffslow")

        trouble = threading.Thread(target=attack)
        trouble.start()
        theirs = client.session("theirs")
        wait_until(lambda: "no frame yet" not in str(theirs.info()["sensors"][0]["reason"]))

        def tracked() -> dict | None:
            with contextlib.suppress(ServiceError):
                return session.track(tour[3][2], 3.0)
            return None

        states.append(wait_until(tracked))
        assert states[3]["status"] == "ok"
        # The spare process goes on with it: nobody waited for a new one to start.
        assert _writers(served, session) == {spare}
        trouble.join(MOST_S)

        refusals = []
        for send in (lambda: attacker.track(tour[4][2]), lambda: attacker.measure("laser", {})):
            with pytest.raises(ServiceError, match="nothing is taken from it for another") as bar:
                send()
            refusals.append(bar.value.status)
        with attacker.stream() as stream:
            stream.send(tour[4][2])
            with pytest.raises(ServiceError, match="for another"):
                stream.receive(MOST_S)
        assert refusals == [429, 429]
        assert _restarts(client) == restarts + 1
        session.close()
    logs = sorted(served.folder.glob("mine-*.mcap"))
    kept = [frame.state for frame in read_log(min(logs, key=lambda path: len(path.name))).frames()]
    assert kept == states


def _writers(served, session) -> set[int]:
    """Worker processes that have the log of a session open."""
    log = (served.folder / session.info()["recording"]["name"]).stat()
    found = set()
    for pid in served.workers:
        for file in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # it has closed it
                if os.path.samestat(file.stat(), log):
                    found.add(pid)
    return found


@pytest.mark.parametrize(
    ("spent_s", "waited_s", "wants_processor", "killed"),
    [
        (0.1, 5.0, True, False),  # others have the processor
        (5.0, 5.0, True, True),
        (0.1, 5.0, False, True),  # it sleeps
        (0.1, 31.0, True, True),  # not even then
    ],
)
def test_a_worker_that_waits_for_a_processor_is_not_killed_for_it(
    monkeypatch, spent_s, waited_s, wants_processor, killed
) -> None:
    """An input may take 5 s of its process's own processor time."""
    ended: list[bool] = []
    handle: WorkerHandle = WorkerHandle(Settings(frame_bytes=4096, frame_timeout_s=5.0))
    handle._process = SimpleNamespace(kill=lambda: ended.append(True))
    handle._sent_at_s = time.monotonic() - waited_s
    monkeypatch.setattr(WorkerHandle, "_wants_processor", wants_processor)
    monkeypatch.setattr(WorkerHandle, "_processor_s", lambda self: spent_s)

    async def late() -> bool:
        handle._timer = Timer(5.0, lambda: None)
        handle._timer.cancel()
        handle._late(5.0)
        return not handle._timer._handle.cancelled()  # it is looked at again

    assert asyncio.run(late()) != killed
    assert bool(ended) == killed


@contextlib.contextmanager
def _running(program: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=MOST_S)


def test_the_processor_time_of_a_worker_is_its_own() -> None:
    handle: WorkerHandle = WorkerHandle(Settings(frame_bytes=4096, frame_timeout_s=5.0))
    with _running("while True: pass") as handle._process:
        wait_until(lambda: handle._wants_processor)
        before_s, ours_s = handle._processor_s(), time.process_time()
        wait_until(lambda: handle._processor_s() - before_s > 0.5)
        spent_s = handle._processor_s() - before_s
        assert spent_s > time.process_time() - ours_s  # this process has only waited
    asleep = "import time; print(flush=True); time.sleep(600)"
    with _running(asleep) as handle._process:
        with ends_in_time(handle._process):
            handle._process.stdout.readline()
        wait_until(lambda: not handle._wants_processor)
        before_s = handle._processor_s()
        time.sleep(0.2)
        assert handle._processor_s() - before_s < 0.1


@pytest.mark.parametrize(
    ("code", "killed", "barred"),
    [(-signal.SIGPROF, False, True), (-signal.SIGSEGV, False, True), (-signal.SIGKILL, True, True),
     (-signal.SIGKILL, False, False), (0, False, False)],
)  # fmt: skip
def test_an_input_is_at_fault_for_its_decoder_and_not_for_what_others_kill(code, killed, barred):
    faults: list[bool] = []
    handle: WorkerHandle = WorkerHandle(Settings(frame_bytes=4096, frame_timeout_s=5.0))
    handle._process = SimpleNamespace(wait=lambda _: code, poll=lambda: code)
    handle._killed = killed
    handle._current = SimpleNamespace(lost=lambda _, at_fault: faults.append(at_fault)), None
    handle.connection_lost(None)
    assert faults == [barred]


def test_an_answer_that_came_in_a_pause_of_the_service_is_read_before_its_worker_is_judged(
    hurried, camera, tour
):
    """Timers come before sockets when a process goes on."""
    served = hurried
    with served.client() as client, client.open(camera, prior=tour[0][1]) as session:
        session.track(tour[0][2])
        restarts = _restarts(client)
        answers: list[dict] = []
        sending = threading.Thread(target=lambda: answers.append(session.track(tour[1][2])))
        (worker,) = _writers(served, session)
        os.kill(worker, signal.SIGSTOP)  # so that the service waits for it
        sending.start()
        with served.client() as other:
            wait_until(lambda: other.session(session.name).info()["age_s"] > 0.3)
        os.kill(served.process.pid, signal.SIGSTOP)
        os.kill(worker, signal.SIGCONT)
        time.sleep(4.0)
        os.kill(served.process.pid, signal.SIGCONT)
        sending.join(MOST_S)
        assert answers[-1]["frame"] == 1
        assert _restarts(client) == restarts
