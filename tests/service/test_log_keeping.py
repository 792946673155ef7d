"""Logs that nobody may harm: other services, damage, other programs; parts and old logs."""

from __future__ import annotations

import asyncio
import errno
import itertools
import json
import os
import struct
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from pydantic_core import to_json
from tests.service.logged import settings_of
from tests.waiting import MOST_S, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.logs import log_file, log_folder, recording
from rendezview_service.logs.log_folder import mend_folder, part_path, remove_old
from rendezview_service.logs.log_lock import folder_lock
from rendezview_service.logs.log_repair import LogPart, join, mend
from rendezview_service.logs.recording import RECORDED, LogWriter
from rendezview_service.logs.recordings import Recordings
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.tracker.tracking import (
    SessionTracker,
    camera_message,
    session_notes,
)

FRAMES = 30
PATIENT = settings_of(log_wait_s=MOST_S)
PICTURE = np.random.default_rng(0).integers(0, 256, 400 * 400, np.uint8).tobytes()


def _write(writer: LogWriter, first: int, count: int, from_s: float = 1.7e9) -> None:
    for k in range(first, first + count):
        state = {"frame": k, "time_s": 0.1 * k, "received_unix_s": from_s + k, "pose": None}
        assert writer.write(state, json.dumps(state).encode(), PICTURE) == RECORDED


def _frames(path: Path) -> list[int]:
    return [frame.state["frame"] for frame in read_log(path).frames() if frame.state is not None]


def _by_other_reader(path: Path) -> list[int]:
    with open(path, "rb") as file:
        found = make_reader(file).iter_messages(topics=["/rendezview/state"])
        return [json.loads(message.data)["frame"] for _, _, message in found]


@pytest.fixture
def written(tmp_path, camera) -> tuple[Path, list[int]]:
    """A finished log, and where each frame ends in it."""
    writer = LogWriter(tmp_path / "run.mcap", camera, {}, None, PATIENT)
    ends = [writer.status.size_bytes]
    for k in range(FRAMES):
        _write(writer, k, 1)
        ends.append(writer.status.size_bytes)
    writer.close()
    return tmp_path / "run.mcap", ends


def test_a_second_service_harms_no_log_of_a_running_one(start_service, camera, tour, tmp_path):
    first = start_service("--record", str(tmp_path))
    acknowledged = []
    seconds: list = []
    with first.client() as client:
        session = client.open(camera, prior=tour[0][1], name="one")

        def track(count: int) -> None:
            for _ in range(count):
                k = len(acknowledged)
                acknowledged.append(session.track(tour[k % len(tour)][2], float(k)))

        track(10)
        starting = threading.Thread(
            target=lambda: seconds.append(start_service("--record", str(tmp_path), given=False))
        )
        starting.start()
        while starting.is_alive():
            track(5)
        track(20)
    first.kill()
    seconds[0].stop()
    assert all(state["recorded"] for state in acknowledged)
    (path,) = tmp_path.glob("one-*.mcap")
    assert [frame.state for frame in read_log(path).frames()] == acknowledged


def test_a_flipped_bit_costs_one_frame_at_most_and_the_old_file_stays(written):
    path, ends = written
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for place in map(int, rng.integers(ends[0], ends[-1], 25)):
        content = bytearray(whole)
        content[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        hit = sum(end <= place for end in ends) - 1
        kept = [k for k in range(FRAMES) if k != hit]
        assert set(kept) <= set(_frames(path)), place
        mended = mend(path)
        if mended is not None:
            assert mended.path != path
            assert set(kept) <= set(_by_other_reader(mended.path))
            mended.path.unlink()
        assert path.read_bytes() == content


@pytest.mark.parametrize("swallowed", [3_000, 1_500_000])
def test_a_flipped_bit_in_the_model_costs_no_frame(tmp_path, camera, swallowed):
    """The model is full of what looks like chunks, with lengths that fit, up to over all frames."""
    length = struct.pack("<Q", 40 + swallowed)
    false = b"\x06" + length + bytes(24) + b"\1\0\0\0" + bytes(4) + struct.pack("<Q", swallowed)
    model = b"\x06" + (false + bytes(3)) * 200
    writer = LogWriter(tmp_path / "run.mcap", camera, {}, model, PATIENT)
    _write(writer, 0, FRAMES)
    writer.close()
    content = bytearray(writer.path.read_bytes())
    content[content.index(model) + 5000] ^= 8
    writer.path.write_bytes(content)
    assert _frames(writer.path) == list(range(FRAMES))
    assert _by_other_reader(mend(writer.path).path) == list(range(FRAMES))


@pytest.mark.parametrize("field", [1, 4, 8])
def test_a_damaged_length_costs_its_frame_only(written, field):
    """Of the fifth frame's chunk: the reader finds the next chunk again."""
    path, ends = written
    content = bytearray(path.read_bytes())
    content[ends[4] + field] ^= 0x40
    path.write_bytes(content)
    kept = [k for k in range(FRAMES) if k != 4]
    assert _frames(path) == kept
    assert _by_other_reader(mend(path).path) == kept


def test_logs_of_other_programs_and_open_logs_are_left_alone(tmp_path, camera):
    other = tmp_path / "other.mcap"
    with open(other, "wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        channel = writer.register_channel("/t", "json", writer.register_schema("x", "", b""))
        for k in range(1000):
            writer.add_message(channel, k, b"{}", k)
        writer.finish()
    os.truncate(other, other.stat().st_size - 40)
    cut = tmp_path / "cut.mcap"
    for path in (cut, tmp_path / "open.mcap"):
        own = LogWriter(path, camera, {}, None, PATIENT)
        _write(own, 0, 3)
        if path == cut:
            left = cut.read_bytes()
            own.close()
            cut.write_bytes(left[:-10])
    before = {path: path.read_bytes() for path in (other, own.path)}
    with pytest.raises(RendezviewError, match="is being written"):
        mend(own.path)
    done = list(mend_folder(tmp_path))
    assert [one["log"] for one in done if "into" in one] == ["cut.mcap"]
    assert _by_other_reader(cut) == [0, 1, 2]
    assert {path: path.read_bytes() for path in before} == before
    _write(own, 3, 1)
    own.close()
    assert _by_other_reader(own.path) == [0, 1, 2, 3]


def test_copies_of_a_repair_that_was_killed_are_removed(tmp_path):
    old, new, other = (
        tmp_path / f".{name}.tmp" for name in ("a.mcap.0123abcd0123", "b.01234567", "c")
    )
    for path in (old, new, other):
        path.write_bytes(b"half")
    for path in (old, other):
        os.utime(path, (0.0, 0.0))
    assert list(mend_folder(tmp_path)) == []
    assert sorted(tmp_path.iterdir()) == sorted([new, other])


def test_two_writers_of_one_name_have_a_file_each(tmp_path, camera):
    writers = [LogWriter(tmp_path / "run.mcap", camera, {}, None, PATIENT) for _ in range(3)]
    assert [w.path.name for w in writers] == ["run.mcap", "run-2.mcap", "run-3.mcap"]
    for writer in writers:
        writer.close()


def test_a_log_in_parts_is_repeated_whole_and_sent_as_one_file(
    tmp_path, refining_model, model_path, camera, tour
):
    request = SessionRequest.model_validate(
        {"camera": camera_message(camera).model_dump(), "prior": tour[0][1].as_dict()}
    )
    base, paths = tmp_path / "run.mcap", []
    for first in (0, 12):  # another worker continues from the twelfth frame
        tracker = SessionTracker("bench", refining_model, request)
        notes = session_notes("bench", request, "bumpy", model_path)
        notes |= {"log": "abc", "first_frame": str(first)}
        size = len(model_path.read_bytes()) + 300_000
        options = settings_of(log_part_bytes=size, log_wait_s=MOST_S)
        writer = LogWriter(base, camera, notes, model_path.read_bytes(), options)
        for time_s, _, image in tour[first : first + 12]:
            state, _ = tracker.track(image, time_s, 1.7e9 + time_s)
            state["frame"] += first
            assert writer.write(state, to_json(state), image.tobytes()) == RECORDED
            if writer.path not in paths:
                paths.append(writer.path)
        writer.close()
    assert len(paths) > 4
    assert paths == [part_path(base, number) for number in range(1, len(paths) + 1)]
    joined = join([LogPart(path) for path in paths])
    one = tmp_path / "aside" / "one.mcap"
    one.parent.mkdir()
    one.write_bytes(b"".join(joined.blocks()))
    assert one.stat().st_size == joined.length < 1.5 * size + 24 * camera.width * camera.height
    assert mend(one) is None
    for path in (base, one):
        assert _frames(path) == list(range(24))
        *_, (_, so_far) = repeat(read_log(path), model_of(read_log(path), None))
        assert (so_far.frames, so_far.differing, so_far.gap) == (24, 0, None)
    assert _by_other_reader(one) == list(range(24))
    with pytest.raises(RendezviewError, match="middle of a run"):
        list(repeat(read_log(paths[1]), refining_model))
    paths[1].unlink()  # as when it was removed for its age
    *_, (_, so_far) = repeat(read_log(base), refining_model)
    assert so_far.gap.startswith("frames ")
    assert so_far.frames > 12  # of the second tracker all


def test_each_log_is_read_once_for_the_list_and_a_damaged_head_hides_no_other(
    tmp_path, camera, monkeypatch
):
    request = SessionRequest(camera=camera_message(camera))
    for k in range(12):
        notes = session_notes(f"{k}", request, "bumpy", Path("a.rvm")) | {"log": f"log {k}"}
        writer = LogWriter(tmp_path / f"{k}.mcap", camera, notes, None, PATIENT)
        _write(writer, 0, 1)
        writer.close()
    content = bytearray((tmp_path / "11.mcap").read_bytes())
    place = content.index(b"rendezview.session")
    content[place : place + 4] = b"none"
    (tmp_path / "11.mcap").write_bytes(content)
    read, head_of = [], log_file.head_of

    def counted(path: Path) -> log_file.LogHead:
        read.append(path)
        return head_of(path)

    monkeypatch.setattr(log_file, "head_of", counted)
    recordings = Recordings(tmp_path)
    for _ in range(2):
        assert {one.session for one in recordings.list()} == set(map(str, range(11)))
    assert sorted(read) == sorted(tmp_path.glob("*.mcap"))


def test_old_logs_go_and_open_ones_stay(tmp_path, camera):
    now_s = time.time()
    writers = [LogWriter(tmp_path / f"{k}.mcap", camera, {}, None, PATIENT) for k in range(4)]
    other = tmp_path / "other.mcap"
    other.write_bytes(b"\x89MCAP0\r\n")
    for k, writer in enumerate(writers):
        _write(writer, 0, 2, now_s - 1000.0 * (4 - k))
        if k != 0:
            writer.close()
        os.utime(writer.path, (0.0, 0.0))  # a copy may have any time of writing
    size = writers[1].path.stat().st_size
    with folder_lock(tmp_path):
        assert remove_old(tmp_path, 1, 0.0, now_s) == []  # another service looks after it
    assert remove_old(tmp_path, 0, 0.0, now_s) == []
    assert [path.name for path in remove_old(tmp_path, 0, 2500.0, now_s)] == ["1.mcap"]
    assert [path.name for path in remove_old(tmp_path, 2 * size, 0.0, now_s)] == ["2.mcap"]
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == [
        "0.mcap", "3.mcap", "other.mcap"
    ]  # fmt: skip
    writers[0].close()


@pytest.mark.parametrize("runs", [False, True])
def test_a_step_of_the_clock_removes_no_log(tmp_path, camera, monkeypatch, runs):
    """Of two days, before the service starts or while it runs; what is old goes all the same.

    The step is that of the module's own clock, which stands for the system's.
    """
    now_s = time.time()
    for name, age_s in (("old", 7200.0), ("new", 10.0)):
        writer = LogWriter(tmp_path / f"{name}.mcap", camera, {}, None, PATIENT)
        _write(writer, 0, 2, now_s - age_s)
        writer.close()
    looks: list[float] = []
    real = log_folder.remove_old

    def look(*about: Any) -> list[Path]:
        looks.append(about[-1])
        return real(*about)

    monkeypatch.setattr(log_folder, "remove_old", look)
    monkeypatch.setattr(log_folder, "_REMOVE_EVERY_S", 0.05)

    async def run() -> None:
        keeping = asyncio.create_task(log_folder.keep_logs(tmp_path, 0, 3600.0))
        if not runs:
            _step(monkeypatch)
        while len(looks) < 3:
            await asyncio.sleep(0.01)
        if runs:
            _step(monkeypatch)
        until = len(looks) + 5
        while len(looks) < until:
            await asyncio.sleep(0.01)
        keeping.cancel()

    asyncio.run(run())
    assert [path.name for path in tmp_path.glob("*.mcap")] == ["new.mcap"]


def _step(monkeypatch) -> None:
    monkeypatch.setattr(log_folder, "time", _Stepped())


class _Stepped:
    monotonic = staticmethod(time.monotonic)

    @staticmethod
    def time() -> float:
        return time.time() + 2.0 * 86_400.0


def test_the_log_of_a_session_that_a_fault_broke_is_sent_whole(service, client, camera, tour):
    session = client.open(camera, prior=tour[0][1], name="broken")
    first = session.track(tour[0][2], 0.0)
    with service.full_disk():
        assert not session.track(tour[1][2], 0.1)["recorded"]
    numbers = itertools.count(2)

    def recorded() -> dict | None:
        state = session.track(tour[2][2], 0.1 * next(numbers))
        return state if state["recorded"] else None

    state = wait_until(recorded)
    got = service.folder / "got.mcap.txt"
    got.write_bytes(session.log())
    assert _by_other_reader(got) == [*range(first["frame"], state["frame"] + 1)]
    session.close()


def test_a_log_whose_last_fsync_fails_stays_as_it_is_written(camera, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "_SYNC_EVERY_S", MOST_S)  # none comes before

    def fails(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    writer = LogWriter(tmp_path / "run.mcap", camera, {}, None, PATIENT)
    _write(writer, 0, 5)
    monkeypatch.setattr(os, "fsync", fails)
    writer.close()
    assert "Input/output error" in (writer.status.fault or "")
    assert _frames(tmp_path / "run.mcap") == [*range(5)]
