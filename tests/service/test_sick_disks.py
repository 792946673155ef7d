"""Disks that fail, hang or lose files: what was acknowledged is kept, and everything is told."""

from __future__ import annotations

import errno
import fcntl
import itertools
import json
import os
import resource
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.service.logged import settings_of
from tests.waiting import MOST_S, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.logs import recording
from rendezview_service.logs.log_part import OpenPart
from rendezview_service.logs.log_repair import mend
from rendezview_service.logs.recording import PENDING, RECORDED, LogWriter
from rendezview_service.logs.replay import read_log

_HANGS = Path(__file__).parent / "sick_disk" / "sitecustomize.py"
PICTURE = np.random.default_rng(0).integers(0, 256, 100 * 100, np.uint8).tobytes()


def _write(writer: LogWriter, k: int) -> str:
    state = {"frame": k, "time_s": 0.1 * k, "received_unix_s": 1.7e9 + k, "pose": None}
    return writer.write(state, json.dumps(state).encode(), PICTURE)


def _frames(*folders: Path) -> list[int]:
    """The frames of all files of logs, file by file."""
    found = []
    for folder in folders:
        for path in sorted(folder.glob("*.mcap"), key=lambda path: (len(path.name), path.name)):
            if path.stat().st_size:
                log = read_log(path)
                log.parts[1:] = []
                found += [frame.state["frame"] for frame in log.frames() if frame.state]
    return found


@pytest.fixture
def logs(tmp_path) -> Path:
    (tmp_path / "logs").mkdir()
    return tmp_path / "logs"


@pytest.fixture
def writer_of(logs, camera) -> Iterator[Callable[..., LogWriter]]:
    """Starts logs, which are closed at the end."""
    writers: list[LogWriter] = []

    def start(**options: object) -> LogWriter:
        asked = settings_of(**{"log_wait_s": MOST_S} | options)
        writers.append(LogWriter(logs / "run.mcap", camera, {}, None, asked))
        return writers[-1]

    yield start
    for writer in writers:
        writer.close()


class Disk:
    """The system's calls for writing logs, which can fail or hang."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.syncs = 0
        self.failing = {"fsync": 0, "writev": 0}  # number of calls that will fail
        self.error: Exception = OSError(errno.EIO, "Input/output error")
        self.answers = threading.Event()
        self.answers.set()
        self.fsync, self.writev = os.fsync, os.writev
        monkeypatch.setattr(os, "fsync", self._fsync)
        monkeypatch.setattr(os, "writev", self._writev)

    def _fsync(self, file: int) -> None:
        self._fault("fsync")
        self.syncs += 1
        self.fsync(file)

    def _writev(self, file: int, pieces: list[memoryview]) -> int:
        self._fault("writev")
        return self.writev(file, pieces)

    def _fault(self, call: str) -> None:
        self.answers.wait(MOST_S)
        if self.failing[call] > 0:
            self.failing[call] -= 1
            raise self.error


@pytest.fixture
def disk(monkeypatch) -> Iterator[Disk]:
    made = Disk(monkeypatch)
    yield made
    made.answers.set()


@pytest.fixture
def no_sync(monkeypatch) -> None:
    """No fsync comes of itself."""
    monkeypatch.setattr(recording, "_SYNC_EVERY_S", MOST_S)


def _removed(path: Path) -> None:
    path.unlink()


def _folder_removed(path: Path) -> None:
    shutil.rmtree(path.parent)


def _truncated(path: Path) -> None:
    os.truncate(path, 0)


def _replaced(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(b"")
    other.replace(path)


@pytest.mark.parametrize("harm", [_removed, _folder_removed, _truncated, _replaced])
@pytest.mark.usefixtures("no_sync")
def test_a_file_that_somebody_takes_away_is_told_and_the_next_has_all(writer_of, logs, harm):
    """All that was acknowledged is still in memory, because no fsync has come."""
    writer = writer_of()
    assert [_write(writer, k) for k in range(5)] == [RECORDED] * 5
    harm(writer.path)
    wait_until(lambda: writer.status.faults)  # without a frame
    assert "run.mcap: it was" in writer.status.fault
    assert [_write(writer, k) for k in range(5, 8)] == [RECORDED] * 3
    status = writer.status
    assert (status.state, status.faults, status.lost, status.pending) == ("on", 1, 0, 0)
    assert _frames(logs) == list(range(8))
    writer.close()
    assert _frames(logs) == list(range(8))


def test_what_was_safe_in_a_file_that_is_removed_is_told_as_lost(writer_of, logs, disk):
    writer = writer_of(sync="always")
    assert [_write(writer, k) for k in range(5)] == [RECORDED] * 5
    writer.path.unlink()
    assert _write(writer, 5) == RECORDED
    assert writer.status.lost == 5
    assert "states lost with it: 5, written again from memory: 0" in writer.status.fault
    assert _frames(logs) == [5]


def test_a_file_that_is_moved_is_completed_where_it_is(writer_of, logs, tmp_path):
    writer = writer_of()
    for k in range(5):
        assert _write(writer, k) == RECORDED
    moved = tmp_path / "kept" / "moved.mcap"
    moved.parent.mkdir()
    writer.path.rename(moved)
    assert _write(writer, 5) == RECORDED
    assert (writer.status.faults, writer.status.lost) == (1, 0)
    assert mend(moved) is None  # it is whole
    writer.close()
    assert sorted(_frames(moved.parent, logs)) == list(range(6))


@pytest.mark.parametrize("error", [OSError(errno.EIO, "a fault"), RuntimeError("a fault")])
@pytest.mark.parametrize("sync", ["always", "interval"])
def test_a_failed_fsync_is_a_failed_record(writer_of, logs, disk, monkeypatch, sync, error):
    """Its file is given up: a second fsync would say that all is well."""
    disk.error = error
    monkeypatch.setattr(recording, "_SYNC_EVERY_S", 0.0)
    writer = writer_of(sync=sync)
    for k in range(3):
        assert _write(writer, k) == RECORDED
    wait_until(lambda: disk.syncs >= 2)
    disk.failing["fsync"] = 1
    for k in range(3, 6):
        assert _write(writer, k) == RECORDED
    wait_until(lambda: writer.status.faults)
    status = writer.status
    assert "a fault" in status.fault
    assert (status.faults, status.lost) == (1, 0)
    wait_until(lambda: (writer.status.state, writer.status.parts) == ("on", 2))
    writer.close()
    assert _frames(logs) == list(range(6))  # none lost, none doubled


def test_a_disk_that_confirms_nothing_keeps_states_pending(writer_of, logs, disk, monkeypatch):
    monkeypatch.setattr(recording, "_RETRY_S", 0.3)
    writer = writer_of(sync="always")
    assert _write(writer, 0) == RECORDED
    disk.failing["fsync"] = 1_000_000
    told = [_write(writer, k) for k in range(1, 4)]
    assert all(one.startswith(f"{PENDING}: ") for one in told), told
    status = writer.status
    assert (status.state, status.pending, status.lost) == ("failed", 3, 0)
    disk.failing["fsync"] = 0
    wait_until(lambda: writer.status.pending == 0)
    assert writer.status.state == "on"
    writer.close()
    assert _frames(logs) == list(range(4))


def test_a_disk_that_hangs_delays_one_answer_and_is_told(writer_of, logs, disk, monkeypatch):
    monkeypatch.setattr(recording, "_LATE_S", 0.1)
    writer = writer_of(log_wait_s=0.05, log_memory_bytes=30 * len(PICTURE))
    wait_until(lambda: writer.status.parts == 1)
    disk.answers.clear()
    told = [_write(writer, k) for k in range(40)]  # more than memory takes
    assert told[0] == PENDING
    wait_until(lambda: writer.status.state == "failed")
    assert "the disk has not answered for" in writer.status.reason
    kept = [k for k, one in enumerate(told) if one.startswith(PENDING)]
    assert kept == list(range(len(kept)))
    assert {one.partition(":")[0] for one in told[len(kept) :]} == {"failed"}
    assert (writer.status.pending, writer.status.lost) == (len(kept), 40 - len(kept))
    disk.answers.set()
    wait_until(lambda: writer.status.pending == 0)
    assert (writer.status.state, writer.status.lost) == ("on", 40 - len(kept))
    writer.close()
    assert _frames(logs) == kept


def test_a_full_disk_is_told_and_all_is_written_when_there_is_room(writer_of, logs, monkeypatch):
    """By the process' own limit of a file's size, which fails as a full disk does."""
    monkeypatch.setattr(recording, "_RETRY_S", 0.3)
    writer = writer_of()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    assert _write(writer, 0) == RECORDED
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        told = [_write(writer, k) for k in range(1, 6)]
        assert all("cannot be written" in one and one.startswith(PENDING) for one in told)
        status = writer.status
        assert (status.state, status.pending, status.lost) == ("failed", 5, 0)
        assert len(list(logs.glob("*.mcap"))) == 1  # trials leave nothing behind
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    wait_until(lambda: writer.status.pending == 0)
    assert writer.status.state == "on"
    assert _write(writer, 6) == RECORDED
    writer.close()
    assert _frames(logs) == list(range(7))
    assert all(mend(path) is None for path in logs.glob("*.mcap"))  # the ends are there too


@pytest.mark.parametrize("sync", ["always", "interval", "never"])
def test_whatever_happens_each_state_is_there_once_or_told_as_lost(
    writer_of, logs, tmp_path, disk, monkeypatch, sync
):
    """Faults in any order. RENDEZVIEW_TEST_FAULTS is their number."""
    for name in ("_RETRY_S", "_CHECK_EVERY_S", "_SYNC_EVERY_S"):
        monkeypatch.setattr(recording, name, 0.01)
    rng, kept = np.random.default_rng(6), tmp_path / "kept"
    kept.mkdir()
    writer = writer_of(sync=sync)
    numbers, told = itertools.count(), Counter()

    def write(count: int) -> None:
        for _ in range(count):
            told[_write(writer, next(numbers)).partition(":")[0]] += 1

    def fail(call: str) -> None:
        disk.failing[call] += int(rng.integers(1, 4))

    def hang() -> None:
        disk.answers.clear()
        threading.Timer(0.05, disk.answers.set).start()

    faults: list[Callable[[], object]] = [
        lambda: _removed(writer.path),
        lambda: _replaced(writer.path),
        lambda: _truncated(writer.path),
        lambda: writer.path.rename(kept / f"{next(names)}.mcap"),
        lambda: fail("fsync"),
        lambda: fail("writev"),
        hang,
    ]
    names = itertools.count()
    for _ in range(int(os.environ.get("RENDEZVIEW_TEST_FAULTS", "25"))):
        write(int(rng.integers(0, 6)))
        wait_until(lambda: writer.status.pending == 0 and writer.status.parts)
        faults[rng.integers(len(faults))]()
        write(int(rng.integers(1, 6)))
        disk.failing = dict.fromkeys(disk.failing, 0)
        disk.answers.wait(MOST_S)
    wait_until(lambda: writer.status.pending == 0)
    writer.close()
    found = Counter(_frames(logs, kept))
    assert set(found.values()) == {1}
    assert next(numbers) - len(found) == writer.status.lost
    assert told["failed"] == 0


def test_a_picture_larger_than_the_memory_is_recorded(writer_of, logs):
    writer = writer_of(log_memory_bytes=10)
    assert [_write(writer, k) for k in range(3)] == [RECORDED] * 3
    writer.close()
    assert _frames(logs) == [0, 1, 2]


def test_a_file_system_without_locks_is_recorded_to_but_never_repaired(
    writer_of, logs, monkeypatch
):
    def no_locks(file: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    writer = writer_of()
    assert _write(writer, 0) == RECORDED
    with pytest.raises(RendezviewError, match="has no locks"):
        mend(writer.path)
    assert _write(writer, 1) == RECORDED
    assert writer.status.faults == 0


def test_an_error_of_the_writer_itself_is_told(writer_of, logs, monkeypatch):
    monkeypatch.setattr(recording, "_RETRY_S", 0.3)
    writer = writer_of()
    assert _write(writer, 0) == RECORDED
    with monkeypatch.context() as patch:
        patch.setattr(OpenPart, "append", lambda *_: [][1])
        assert "an internal error, IndexError" in _write(writer, 1)
    wait_until(lambda: writer.status.pending == 0)
    writer.close()
    assert _frames(logs) == [0, 1]


def test_a_service_whose_logs_are_removed_says_so_and_goes_on(
    start_service, camera, tour, tmp_path
):
    place = tmp_path / "logs"
    served = start_service("--record", str(place))
    with served.client() as client:
        session = client.open(camera, prior=tour[0][1], name="run")
        for time_s, _, image in tour[:3]:
            assert session.track(image, time_s)["record"] == RECORDED
        shutil.rmtree(place)
        health = wait_until(lambda: _degraded(client))  # before the next frame
        assert "it was removed while it was written" in health["reasons"][0]
        state = session.track(tour[3][2], tour[3][0])
        assert state["record"] == RECORDED
        metrics = client.fetch("GET", "/metrics").decode()
        assert 'rendezview_log_faults{session="run"} 1.0' in metrics
        events = client.request("GET", "/v1/sessions/run/events")["events"]
        texts = [event["text"] for event in events]
        assert any("it was removed" in text for text in texts), texts
        got = tmp_path / "got.mcap"
        got.write_bytes(session.log())
        assert state["frame"] in [frame.state["frame"] for frame in read_log(got).frames()]
    served.stop()
    assert state["frame"] in _frames(place)


def _degraded(client) -> dict | None:
    health = client.request("GET", "/healthz")
    return health if health["status"] == "degraded" else None


def test_a_disk_that_hangs_costs_no_pose_and_no_worker(start_service, camera, tour, tmp_path):
    """For longer than a frame may take, after which a worker is killed."""
    place, sign, frame_s = tmp_path / "logs", tmp_path / "hangs", 2.0
    served = start_service(
        *("--record", str(place)),
        before=_HANGS.read_text(),
        SICK_DISK=str(sign),
        RENDEZVIEW_SERVE_LOG_WAIT_S="0.1",
        RENDEZVIEW_SERVE_FRAME_TIMEOUT_S=str(frame_s),
    )
    with served.client() as client:
        session = client.open(camera, prior=tour[0][1], name="run")
        times_s, workers = itertools.count(), served.workers

        def track() -> dict:
            return session.track(tour[0][2], 0.1 * next(times_s))

        wait_until(lambda: track()["record"] == RECORDED)
        sign.touch()
        until_s, states = time.monotonic() + 1.5 * frame_s, []
        while time.monotonic() < until_s:
            states.append(track())
            time.sleep(0.05)
        assert {(state["status"], state["recorded"]) for state in states} == {("ok", False)}
        assert "the disk has not answered for" in states[-1]["record"]
        assert "the disk has not answered for" in client.request("GET", "/healthz")["reasons"][0]
        sign.unlink()
        wait_until(lambda: session.info()["recording"]["pending"] == 0)
        wait_until(lambda: client.request("GET", "/healthz")["status"] == "ok")
        assert served.workers == workers
        frames = track()["frame"] + 1
        session.close()
    served.stop()
    assert _frames(place) == list(range(frames))
