"""Checkpoints of a session: the newest one is there, and a sick disk delays no state."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from tests.waiting import wait_until

from rendezview.errors import RendezviewError
from rendezview_service.hub import checkpoint
from rendezview_service.hub.checkpoint import (
    Checkpoint,
    CheckpointKeeper,
    Tracked,
    checkpoint_path,
    kept_in,
    lock_state,
    read_checkpoint,
)
from rendezview_service.messages.messages import SessionRequest


def _after(frames: int) -> Checkpoint:
    tracked = Tracked(frames=frames, found=0, last=None, last_found=None, found_unix_s=None)
    request = SessionRequest(id="run")
    about = {"log": "a", "log_base": None, "log_paths": [], "fused": False}
    return Checkpoint(request=request, model_sha256="b", tracked=tracked, **about)


@pytest.fixture
def path(tmp_path) -> Path:
    folder = tmp_path / "open"
    folder.mkdir()
    return checkpoint_path(folder, "run")


def test_a_checkpoint_that_cannot_be_read_hides_no_other(path):
    keeper = CheckpointKeeper(path)
    keeper.keep(_after(3))
    wait_until(keeper.end)
    checkpoint_path(path.parent, "half").write_text('{"request":')
    checkpoint_path(path.parent, "odd").mkdir()
    assert [kept.tracked.frames for kept in kept_in(path.parent)] == [3]


def test_two_services_do_not_have_one_state(tmp_path):
    ours = lock_state(tmp_path / "state")
    with pytest.raises(RendezviewError, match="another service has its state there"):
        lock_state(tmp_path / "state")
    os.close(ours)
    os.close(lock_state(tmp_path / "state"))


def _frames(path: Path) -> int | None:
    kept = read_checkpoint(path)
    return None if kept is None else kept.tracked.frames


def test_a_checkpoint_is_there_when_the_state_is_acknowledged(path, monkeypatch):
    monkeypatch.setattr(checkpoint, "_WAIT_S", 60.0)
    keeper = CheckpointKeeper(path)
    for frames in range(1, 20):
        keeper.keep(_after(frames))
        assert (_frames(path), keeper.reason) == (frames, None)
    assert keeper.end()
    assert _frames(path) == 19  # for the next service
    keeper = CheckpointKeeper(path)
    assert keeper.end(remove=True)
    assert list(path.parent.iterdir()) == []


def test_a_disk_that_fails_is_told_until_it_works_again(path):
    keeper = CheckpointKeeper(path)
    path.parent.rmdir()
    for frames in range(3):
        keeper.keep(_after(frames))
    wait_until(lambda: "cannot be written" in (keeper.reason or ""))
    path.parent.mkdir()
    keeper.keep(_after(3))
    wait_until(lambda: keeper.reason is None)
    assert _frames(path) == 3
    wait_until(keeper.end)


def test_a_disk_that_hangs_delays_one_state_and_gets_the_newest_checkpoint(path, monkeypatch):
    answers, waits_s, write = threading.Event(), [], checkpoint.write_checkpoint

    def hang(*about: object) -> None:
        answers.wait()
        write(*about)

    class Counted(threading.Condition):
        def wait_for(self, happened, timeout=None):
            if timeout is not None:
                waits_s.append(timeout)
            return super().wait_for(happened, timeout)

    monkeypatch.setattr(checkpoint, "write_checkpoint", hang)
    monkeypatch.setattr(threading, "Condition", Counted)
    keeper = CheckpointKeeper(path)
    for frames in range(50):
        keeper.keep(_after(frames))
    assert len(waits_s) == 1  # of fifty states
    wait_until(lambda: keeper.reason is not None)
    assert "has not answered for" in keeper.reason
    assert not keeper.end()
    answers.set()
    wait_until(keeper.end)
    assert _frames(path) == 49
    assert keeper.reason is None
