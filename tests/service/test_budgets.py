"""Clients that hold what they can: they pay for it, and neither a neighbour nor the operator."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.service.hostile_clients import (
    LOG,
    begin_message,
    connected,
    head,
    large_log,
    resident_mb,
)
from tests.waiting import MOST_S, wait_until
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from rendezview.geometry.camera import Camera
from rendezview_service.client import ServiceError

CONNECTIONS = 100  # of the service: half for requests, a quarter for WebSockets
BODIES_MB = 40.0
# Answers that nobody reads are closed soon.
HURRY = """
import sys
if "serve" in sys.orig_argv:
    import rendezview_service.http.connections as connections
    connections._READ_S = 3.0
"""


@pytest.fixture(scope="module")
def served(start_service, tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    served = start_service(
        RENDEZVIEW_SERVE_CONNECTIONS=str(CONNECTIONS),
        RENDEZVIEW_SERVE_BODIES_BYTES=str(int(1e6 * BODIES_MB)),
        RENDEZVIEW_SERVE_RECORD=str(folder),
        RENDEZVIEW_SERVE_COMPRESSION="",
        before=HURRY,
    )
    served.folder = folder
    yield served
    served.stop()


def _sockets(served) -> int:
    """Number of sockets that the service has open."""
    found = 0
    for file in Path(f"/proc/{served.process.pid}/fd").iterdir():
        with contextlib.suppress(OSError):  # it has closed it
            found += os.readlink(file).startswith("socket:")
    return found


def _neighbour(served, camera, tour) -> None:
    """Somebody else tracks, on connections of before and new ones; health answers too."""
    for _ in range(3):
        with served.client() as client, client.open(camera, prior=tour[0][1]) as session:
            for time_s, _, image in tour[:5]:  # by arrival, a busy machine makes odd rates of them
                assert session.track(image, time_s)["status"] == "ok"
            with session.stream() as stream:
                stream.send(tour[5][2], tour[5][0])
                assert stream.receive(MOST_S)["status"] == "ok"
        for path in ("healthz", "metrics"):
            assert httpx.get(served.url + path, timeout=MOST_S).status_code == 200


@contextlib.contextmanager
def _trickling(connections: list[socket.socket]) -> Iterator[None]:
    done = threading.Event()

    def trickle() -> None:
        while not done.wait(0.2):
            for connection in connections:
                with contextlib.suppress(OSError):
                    connection.sendall(b" ")

    thread = threading.Thread(target=trickle)
    thread.start()
    yield
    done.set()
    thread.join(MOST_S)


def test_bodies_that_trickle_make_room_for_a_neighbour(served, camera, tour):
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(connected(served.url)) for _ in range(CONNECTIONS + 30)]
        for connection in held:
            with contextlib.suppress(OSError):
                connection.sendall(head("/v1/sessions", 100_000) + b"{")
        with _trickling(held):
            _neighbour(served, camera, tour)
            health = httpx.get(served.url + "healthz", timeout=MOST_S).json()
            metrics = httpx.get(served.url + "metrics", timeout=MOST_S).text
        refused = b""
        for connection in held:
            connection.settimeout(0.01)
            with contextlib.suppress(OSError):
                refused += connection.recv(2000)
    assert refused.count(b"too many requests at once") >= CONNECTIONS // 2
    assert b"HTTP/1.1 503" in refused
    assert b"retry-after" in refused.lower()
    assert health["budgets"]["requests"]["exceeded"]
    assert health["budgets"]["connections"]["most"] == CONNECTIONS
    assert any("budget requests is used up" in reason for reason in health["reasons"])
    assert f'rendezview_budget_most{{budget="requests"}} {CONNECTIONS // 2}.0' in metrics


@pytest.mark.parametrize(
    ("kind", "most_mb"), [("models", 0.5 * BODIES_MB), ("frames", 1.25 * BODIES_MB),
                          ("messages", 1.25 * BODIES_MB)],
)  # fmt: skip
def test_what_many_send_holds_no_more_than_its_budget_and_is_given_back(
    served, camera, tour, kind, most_mb
):
    """Models go to the disk."""
    _neighbour(served, camera, tour)
    before_mb = resident_mb(served.process.pid)
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(served.client())
        name = stack.enter_context(client.open(Camera.from_fov(1900, 1600, 0.7))).name
        held = [stack.enter_context(connected(served.url)) for _ in range(8)]
        peak_mb = 0.0
        for k, connection in enumerate(held):
            with contextlib.suppress(OSError):
                if kind == "messages":
                    begin_message(connection, name, 31_000_000, 30_000_000)
                else:
                    path = f"/v1/sessions/{name}/frames"
                    way = ("PUT", f"/v1/models/m{k}") if kind == "models" else ("POST", path)
                    connection.sendall(head(way[1], 31_000_000, way[0]) + bytes(30_000_000))
            peak_mb = max(peak_mb, resident_mb(served.process.pid))
        _neighbour(served, camera, tour)
        peak_mb = max(peak_mb, resident_mb(served.process.pid))
    assert peak_mb - before_mb < most_mb
    wait_until(lambda: resident_mb(served.process.pid) - before_mb < 0.5 * BODIES_MB)


def test_a_frame_longer_than_any_of_its_camera_is_refused_by_itshead(served, camera, tour):
    with served.client() as client, client.open(camera) as session:
        with connected(served.url) as connection:
            connection.sendall(head(f"/v1/sessions/{session.name}/frames", 31_900_000))
            assert b" 413 " in connection.recv(200)
        with session.stream() as stream:
            stream.send(bytes(4_000_000))
            with pytest.raises(ServiceError, match="too long"):
                stream.receive(MOST_S)
            stream.send(tour[0][2])
            assert stream.receive(MOST_S)["frame"] == 0


def _is_open(stream: ClientConnection) -> bool:
    with contextlib.suppress(TimeoutError, WebSocketException):
        stream.recv(0.0)
    return stream.state.name == "OPEN"


def test_websockets_of_one_client_make_room_for_another(served, camera, tour):
    with served.client() as client, client.open(camera, prior=tour[0][1]) as session:
        url = client.stream_url(session.name, "stream")
        with contextlib.ExitStack() as stack:
            mine = stack.enter_context(session.stream())
            held = []
            for _ in range(CONNECTIONS + 20):
                with contextlib.suppress(WebSocketException, OSError):  # one that was cut at once
                    held.append(stack.enter_context(connect(url, open_timeout=MOST_S)))
                mine.send(tour[0][2])  # whoever sends stays
                assert mine.receive(MOST_S)["status"] == "ok"
            _neighbour(served, camera, tour)
            mine.send(tour[0][2])
            assert mine.receive(MOST_S)["status"] == "ok"
            wait_until(lambda: sum(map(_is_open, held)) < CONNECTIONS // 4)
            assert len(held) > CONNECTIONS


def test_a_stream_that_waits_holds_no_bytes(served, camera, tour):
    with served.client() as client, client.open(camera) as session, session.stream() as stream:
        for _ in range(3):
            stream.send(tour[0][2])
            stream.receive(MOST_S)
            health = httpx.get(served.url + "healthz", timeout=MOST_S).json()
            assert health["budgets"]["bodies_bytes"]["used"] == 0


def test_downloads_that_nobody_reads_end_and_give_back_what_they_hold(served, camera, tour):
    """Each is far more than the system's own buffers take."""
    length = large_log(served.folder / LOG, camera, 60)
    _neighbour(served, camera, tour)
    before, before_mb = wait_until(lambda: _sockets(served)), resident_mb(served.process.pid)
    asked = head(f"/v1/recordings/{LOG}/log", None, "GET")
    with contextlib.ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(connected(served.url)).sendall(asked)
        start_s = time.monotonic()
        wait_until(lambda: _sockets(served) <= before)
        assert time.monotonic() - start_s < 30.0  # ten times what an answer may wait
    kept_mb = []
    for _ in range(2):  # the second time finds the memory that the first one gave back
        with contextlib.ExitStack() as stack:  # more than there may be at once
            for _ in range(CONNECTIONS - 20):
                stack.enter_context(connected(served.url)).sendall(asked)
            _neighbour(served, camera, tour)
            assert resident_mb(served.process.pid) - before_mb < 60.0
        wait_until(lambda: _sockets(served) <= before)
        kept_mb.append(resident_mb(served.process.pid))
    assert kept_mb[1] - kept_mb[0] < 10.0, (before_mb, kept_mb)
    url = f"{served.url}v1/recordings/{LOG}/log"
    assert len(httpx.get(url, timeout=MOST_S).content) >= length
