"""A request that arrives twice is done once, and both get the first answer."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from urllib.parse import urlsplit

import httpx
import pytest
from tests.waiting import MOST_S

from rendezview.errors import RendezviewError
from rendezview_service.client import Client
from rendezview_service.hub.once import Once


class Cutting:
    """Passes connections on; answers to POSTs are cut off, every second one."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._to = parts.hostname or "", parts.port or 0
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._server.getsockname()[1]}"
        self.posts = self.cuts = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._server.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                ours, _ = self._server.accept()
                theirs = socket.create_connection(self._to)
                threading.Thread(target=self._answers, args=(theirs, ours), daemon=True).start()
                threading.Thread(target=self._requests, args=(ours, theirs), daemon=True).start()

    def _requests(self, ours: socket.socket, theirs: socket.socket) -> None:
        with contextlib.suppress(OSError), theirs:
            while data := ours.recv(1 << 16):
                self.posts += data.startswith(b"POST ")
                theirs.sendall(data)

    def _answers(self, theirs: socket.socket, ours: socket.socket) -> None:
        with contextlib.suppress(OSError), ours:
            while data := theirs.recv(1 << 16):
                if self.posts > 2 * self.cuts + 1:
                    self.cuts += 1
                    if self.cuts % 2:  # after some of it, or before
                        ours.sendall(data[:-1])
                    ours.shutdown(socket.SHUT_RDWR)
                    return
                ours.sendall(data)


@pytest.fixture
def cutting(service) -> Iterator[Cutting]:
    proxy = Cutting(service.url)
    yield proxy
    proxy.close()


def test_of_answers_that_are_cut_off_no_frame_and_no_line_is_taken_twice(cutting, camera, tour):
    with Client(cutting.url, timeout_s=MOST_S) as client:
        client.sessions()
        session = client.open(camera, prior=tour[0][1])
        states = [session.track(image) for _, _, image in tour[:8]]
        pose, square = states[-1]["pose"], states[-1]["covariance"]
        for k in range(4):
            line = {"time_s": states[-1]["time_s"] + 0.01 * k, "pose": pose, "covariance": square}
            answer = session.measure("other", line)
            assert len(answer["verdicts"]) == 1
        info = session.info()
        assert [one["id"] for one in client.sessions()] == [session.name]
        session.close()
    assert cutting.cuts >= 5
    assert cutting.posts > 13
    assert [state["frame"] for state in states] == list(range(8))
    assert info["frames"] == 8
    assert [one["frames"] for one in info["sensors"] if one["name"] == "other"] == [4]


def _post(url: str, content: bytes, key: str) -> httpx.Response:
    headers = {"Idempotency-Key": key, "Content-Type": "application/json"}
    return httpx.post(url, content=content, headers=headers, timeout=MOST_S)


def test_a_repeat_with_the_same_key_gets_the_first_answer(service, client, camera, tour):
    session = client.open(camera, prior=tour[0][1])
    frames = f"{service.url}v1/sessions/{session.name}/frames"
    image = tour[0][2].tobytes()
    first, repeat, other = (_post(frames, image, key) for key in ("a", "a", "b"))
    assert first.content == repeat.content
    assert (first.json()["frame"], other.json()["frame"]) == (0, 1)
    wrong = [_post(frames + "?time_s=1e9", image, key) for key in ("c", "c")]
    assert [answer.status_code for answer in wrong] == [422, 422]
    for key, content, said in [("a", image[1:], "another request"), ("k" * 200, image, "128")]:
        refused = _post(frames, content, key)
        assert refused.status_code == 422
        assert said in refused.json()["error"]
    assert session.info()["frames"] == 2
    session.close()


def test_an_opening_that_is_repeated_opens_one_session(service, client):
    request = json.dumps({"camera": {"width": 320, "height": 240, "fx": 400.0, "fy": 400.0,
                                     "cx": 159.5, "cy": 119.5}}).encode()  # fmt: skip
    url = f"{service.url}v1/sessions"
    both = [_post(url, request, "one") for _ in range(2)]
    assert [answer.status_code for answer in both] == [201, 201]
    (name,) = {answer.json()["id"] for answer in both}
    assert [one["id"] for one in client.sessions()] == [name]
    client.session(name).close()
    assert _post(url, request, "one").status_code == 404  # it has ended: another key opens another


def test_a_repeat_waits_for_the_first_and_the_oldest_is_forgotten():
    async def run() -> list[int]:
        once: Once[int] = Once(2)
        done: list[int] = []

        async def work() -> int:
            await asyncio.sleep(0.01)
            done.append(len(done))
            return done[-1]

        async def fail() -> int:
            raise RendezviewError("not now")

        both = await asyncio.gather(once.do("a", 1, work), once.do("a", 1, work))
        with pytest.raises(RendezviewError, match="not now"):
            await once.do("b", 1, fail)
        later = [await once.do(key, 1, work) for key in ("b", "b", "c", "a")]
        with pytest.raises(RendezviewError, match="another request"):
            await once.do("a", 2, work)
        return [*both, *later, await once.do(None, 1, work)]

    assert asyncio.run(run()) == [0, 0, 1, 1, 2, 3, 4]
