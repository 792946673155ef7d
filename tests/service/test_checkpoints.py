"""Checkpoints of a session: the newest one is there, and a sick disk delays no state."""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import httpx
import pytest
from tests.http_server import http_server
from tests.waiting import MOST_S, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.client import Client, ServiceError
from rendezview_service.http.app import make_app
from rendezview_service.hub import checkpoint
from rendezview_service.hub.checkpoint import (
    Checkpoint,
    CheckpointKeeper,
    checkpoint_path,
    kept_in,
    lock_state,
    read_checkpoint,
    write_checkpoint,
)
from rendezview_service.hub.progress import Progress
from rendezview_service.hub.service import Service
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.settings import Settings


def _after(frames: int) -> Checkpoint:
    tracked = Progress(frames=frames)
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


@pytest.mark.parametrize(("confidence", "posterior"), [(0.97, 0.97), (0.7, 0.9)])
def test_the_next_tracker_is_no_surer_of_the_last_pose_than_the_last_one_was(confidence, posterior):
    """A pose that was given has 0.9 among its look-alikes, whatever else makes it doubtful."""
    pose = {"quat_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [0.0, 0.0, 9.0]}
    state = json.dumps({"pose": pose, "confidence": confidence}).encode()
    progress = Progress(last_found=state, found_unix_s=time.time())
    prior, known = progress.prior
    assert (prior.translation_m, known) == ([0.0, 0.0, 9.0], posterior)
    asked = SessionRequest(id="run", prior=prior, prior_posterior=known)
    assert SessionRequest.model_validate_json(asked.model_dump_json()) == asked


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

    async def answers() -> None:
        for frames in range(1, 20):
            answered = asyncio.Event()
            keeper.keep(_after(frames), answered.set)
            await asyncio.wait_for(answered.wait(), MOST_S)
            assert (_frames(path), keeper.reason) == (frames, None)

    asyncio.run(answers())
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
    answers, write = threading.Event(), checkpoint.write_checkpoint

    def hang(*about: object) -> None:
        answers.wait(MOST_S)
        write(*about)

    monkeypatch.setattr(checkpoint, "write_checkpoint", hang)
    keeper = CheckpointKeeper(path)

    async def states() -> None:
        for frames in range(50):
            answered = asyncio.Event()
            keeper.keep(_after(frames), answered.set)
            assert answered.is_set() == (frames > 0)
            await asyncio.wait_for(answered.wait(), MOST_S)

    asyncio.run(states())
    wait_until(lambda: keeper.reason is not None)
    assert "has not answered for" in keeper.reason
    assert not keeper.end()
    answers.set()
    wait_until(keeper.end)
    assert _frames(path) == 49
    assert keeper.reason is None


def test_a_session_of_an_earlier_run_is_not_unknown_before_it_goes_on(tmp_path):
    write_checkpoint(checkpoint_path(tmp_path, "run"), _after(1))
    guard = make_app(Service(Settings(state_folder=tmp_path)), [])  # it has not started yet

    async def ask(session: str) -> httpx.Response:
        transport = httpx.ASGITransport(guard)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.post(f"/v1/sessions/{session}/frames", content=b"frame")

    answer = asyncio.run(ask("run"))
    assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")
    assert "goes on in a moment" in answer.json()["error"]
    assert asyncio.run(ask("other")).status_code == 404


def test_the_client_waits_for_a_session_that_goes_on_in_a_moment():
    asked = []

    class Answers(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            waits = len(asked) in (2, 3)
            body = b'{"error": "in a moment"}' if waits else b'{"sessions": []}'
            self.send_response(503 if waits else 200)
            self.send_header("Content-Length", str(len(body)))
            if waits:
                self.send_header("Retry-After", "0")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with http_server(Answers) as port:
        url = f"http://127.0.0.1:{port}"
        with Client(url) as client:
            assert client.sessions() == client.sessions() == []
        assert len(asked) == 4
        del asked[1:]
        with Client(url) as client, pytest.raises(ServiceError, match="in a moment"):
            client.sessions()  # it was not reached before: the answer is passed on
