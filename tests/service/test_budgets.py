"""Clients that hold what they can: they pay for it, and neither a neighbour nor the operator."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from tests.waiting import MOST_S, wait_until
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

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
    folder = tmp_path_factory.mktemp("hurry")
    (folder / "sitecustomize.py").write_text(HURRY)
    served = start_service(
        RENDEZVIEW_SERVE_CONNECTIONS=str(CONNECTIONS),
        RENDEZVIEW_SERVE_BODIES_BYTES=str(int(1e6 * BODIES_MB)),
        RENDEZVIEW_SERVE_RECORD=str(folder),
        RENDEZVIEW_SERVE_COMPRESSION="",
        PYTHONPATH=str(folder),
    )
    yield served
    served.stop()


def _connected(url: str) -> socket.socket:
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname or "", parts.port or 0), timeout=MOST_S)


def _head(path: str, length: int, method: str = "POST") -> bytes:
    return (
        f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        f"Content-Length: {length}\r\n\r\n"
    ).encode()


def _resident_mb(served) -> float:
    return int(Path(f"/proc/{served.process.pid}/statm").read_text().split()[1]) * 4096 / 1e6


def _neighbour(served, camera, tour) -> None:
    """Somebody else tracks, on connections of before and new ones; health answers too."""
    for _ in range(3):
        with served.client() as client, client.open(camera, prior=tour[0][1]) as session:
            for _, _, image in tour[:5]:
                assert session.track(image)["status"] == "ok"
            with session.stream() as stream:
                stream.send(tour[5][2])
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
    thread.join()


def test_bodies_that_trickle_make_room_for_a_neighbour(served, camera, tour):
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(_connected(served.url)) for _ in range(CONNECTIONS + 30)]
        for connection in held:
            with contextlib.suppress(OSError):
                connection.sendall(_head("/v1/sessions", 100_000) + b"{")
        with _trickling(held):
            _neighbour(served, camera, tour)
        refused = b""
        for connection in held:
            connection.settimeout(0.01)
            with contextlib.suppress(OSError):
                refused += connection.recv(2000)
    assert refused.count(b"too many requests at once") >= CONNECTIONS // 2
    assert b"HTTP/1.1 503" in refused
    assert b"retry-after" in refused.lower()


def test_large_bodies_hold_no_more_than_their_budget_and_give_it_back(served, camera, tour):
    _neighbour(served, camera, tour)
    before_mb = _resident_mb(served)
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(_connected(served.url)) for _ in range(8)]
        peak_mb = 0.0
        for k, connection in enumerate(held):
            with contextlib.suppress(OSError):
                connection.sendall(_head(f"/v1/models/m{k}", 36_000_000, "PUT"))
                connection.sendall(bytes(35_000_000))
            peak_mb = max(peak_mb, _resident_mb(served))
        _neighbour(served, camera, tour)
        peak_mb = max(peak_mb, _resident_mb(served))
    assert peak_mb - before_mb < 2.5 * BODIES_MB  # the bodies, and what is on its way
    wait_until(lambda: _resident_mb(served) - before_mb < 0.5 * BODIES_MB)


def test_a_frame_longer_than_any_of_its_camera_is_refused_by_its_head(served, camera, tour):
    with served.client() as client, client.open(camera) as session:
        with _connected(served.url) as connection:
            connection.sendall(_head(f"/v1/sessions/{session.name}/frames", 31_900_000))
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
            mine = session.stream()
            held = []
            for _ in range(CONNECTIONS + 20):
                held.append(stack.enter_context(connect(url, open_timeout=MOST_S)))
                mine.send(tour[0][2])  # whoever sends stays
                assert mine.receive(MOST_S)["status"] == "ok"
            _neighbour(served, camera, tour)
            mine.send(tour[0][2])
            assert mine.receive(MOST_S)["status"] == "ok"
            wait_until(lambda: sum(map(_is_open, held)) < CONNECTIONS // 4)
            mine.close()
