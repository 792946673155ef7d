"""Clients that take what they can, in numbers, and one beside them that only tracks."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from http.client import HTTPConnection, HTTPException
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from experiments.frame import tests_module
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview_service.client import Client

clients, cases = tests_module("service.hostile_clients"), tests_module("service.fuzz_cases")
hostile = tests_module("service.hostile_pictures").hostile
MOST_S = tests_module("waiting").MOST_S
THEIRS = "theirs"  # a session
THEIR_CAMERA = Camera.from_fov(640, 480, 0.7)
_BACK_S = 60.0  # s, in which memory is given back
_RATE_HZ = 5.0  # of the innocent client


def hold(url: str, count: int, first: bytes, again: bytes, until_s: float) -> None:
    """So many connections, each with a request that it goes on with; lost ones are renewed."""
    held: list[socket.socket] = []
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError):
            while len(held) < count:
                held.append(clients.connected(url))
                held[-1].sendall(first)
        for connection in list(held):
            try:
                connection.settimeout(0.0)
                connection.send(again) if again else connection.recv(1, socket.MSG_PEEK)
            except BlockingIOError:
                pass
            except OSError:
                connection.close()
                held.remove(connection)
        time.sleep(0.2)
    for connection in held:
        connection.close()


def many(url: str, count: int, once: Callable[[HTTPConnection, int], None], until_s: float) -> None:
    """So many threads that ask again and again."""
    parts = urlsplit(url)

    def ask(number: int) -> None:
        while time.monotonic() < until_s:
            http = HTTPConnection(parts.hostname or "", parts.port, timeout=10.0)
            with contextlib.suppress(OSError, HTTPException, RendezviewError):
                once(http, number)
            http.close()

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(MOST_S)


def attack(name: str, url: str, seconds: float) -> None:
    """Be one of `KINDS` for a while."""
    count, body, until_s = KINDS[name], bytes(31_900_000), time.monotonic() + seconds
    match name:
        case "nobody":
            time.sleep(max(0.0, until_s - time.monotonic()))
        case "bodies that trickle":
            hold(url, count, clients.head("/v1/sessions", 100_000) + b"{", b" ", until_s)
        case "WebSockets":
            hold(url, count, clients.upgrade(THEIRS), b"\x89\x80" + bytes(4), until_s)  # a ping
        case "downloads that nobody reads":
            first = clients.head(f"/v1/recordings/{clients.LOG}/log", None, "GET")
            hold(url, count, first, b"", until_s)
        case "bodies of 31.9 MB":

            def send(http: HTTPConnection, number: int) -> None:
                http.connect()
                http.sock.sendall(clients.head(f"/v1/models/m{number}", 32_000_000, "PUT") + body)
                http.sock.recv(1000)

            many(url, count, send, until_s)
        case "messages of 31.9 MB":

            def begin(http: HTTPConnection, _: int) -> None:
                http.connect()
                clients.begin_message(http.sock, THEIRS, 32_000_000, 31_900_000)
                http.sock.recv(1000)

            many(url, count, begin, until_s)
        case "a picture of many chunks":
            grey = np.random.default_rng(1).integers(0, 256, (480, 640), np.uint8)
            picture = hostile(grey, 2_200_000)["png, chunks of a byte"]()

            def show(http: HTTPConnection, _: int) -> None:
                http.request("POST", f"/v1/sessions/{THEIRS}/frames", picture)
                http.getresponse().read()

            many(url, count, show, until_s)
        case "uploads":

            def upload(http: HTTPConnection, _: int) -> None:
                http.request("PUT", "/v1/models/same?replace=true", body[:20_000_000])
                http.getresponse().read()

            many(url, count, upload, until_s)
        case "a head of 66 MB":

            def talk(http: HTTPConnection, _: int) -> None:
                http.connect()
                http.sock.sendall(b"GET / HTTP/1.1\r\nX: " + body + body)
                http.sock.recv(1000)

            many(url, count, talk, until_s)


# Names of hostile clients, and how many connections each has.
KINDS = {
    "nobody": 0,
    "bodies that trickle": 1100,
    "WebSockets": 1000,
    "bodies of 31.9 MB": 33,
    "messages of 31.9 MB": 33,
    "downloads that nobody reads": 300,
    "a picture of many chunks": 3,
    "uploads": 8,
    "a head of 66 MB": 1,
}


class Innocent:
    """A client that tracks five frames a second; ``gap_s`` is its longest time without a state."""

    def __init__(self, url: str, frame: np.ndarray) -> None:
        self.gap_s, self.states, self._last_s = 0.0, 0, time.monotonic()
        self.faults: list[str] = []
        self._url, self._frame = url, frame

    @contextlib.contextmanager
    def tracking(self) -> Iterator[None]:
        """It tracks meanwhile."""
        done = threading.Event()
        thread = threading.Thread(target=self._track, args=(done,))
        thread.start()
        yield
        done.set()
        thread.join(MOST_S)

    def _track(self, done: threading.Event) -> None:
        with Client(self._url, timeout_s=10.0) as client:
            session = client.open(cases.CAMERA, idle_s=600.0)
            session.track(self._frame)
            self._last_s = time.monotonic()
            while not done.wait(1.0 / _RATE_HZ):
                try:
                    session.track(self._frame)
                except RendezviewError as error:
                    self.faults.append(str(error))
                    continue
                now_s = time.monotonic()
                self.gap_s, self._last_s = max(self.gap_s, now_s - self._last_s), now_s
                self.states += 1
            session.close()


def campaign(served: Any, logs: Path, seconds: float) -> Iterator[str]:
    """Each kind for a while, beside an innocent client; what it cost, a line each.

    Args:
        logs: the folder of the service's recordings.
    """
    clients.large_log(logs / clients.LOG, cases.CAMERA, 200)
    frame = np.frombuffer(cases.Cases(0).good[0], np.uint8).reshape(120, 160)

    def memory_mb() -> np.ndarray:
        return np.array([served.resident_mb(served.process.pid), served.resident_mb()])

    with Client(served.url) as client:
        client.open(THEIR_CAMERA, name=THEIRS, idle_s=36_000.0)
        for name in KINDS:
            innocent, told = Innocent(served.url, frame), Counter[str]()
            before = most = memory_mb()
            of = name, served.url, seconds
            apart = get_context("spawn").Process(target=attack, args=of)
            with innocent.tracking():
                apart.start()
                while apart.is_alive():
                    most = np.maximum(most, memory_mb())
                    told.update(client.request("GET", "/healthz")["reasons"])
                    time.sleep(0.25)
            time.sleep(_BACK_S)
            memory = (f"{k[0]:.0f}, {k[1]:.0f}" for k in (before, most, memory_mb()))
            yield (
                f"{name}: gap {innocent.gap_s:.2f} s, {innocent.states} states, faults "
                f"{dict(Counter(innocent.faults))}; MB (service, all) {' / '.join(memory)}; "
                f"load {os.getloadavg()[0]:.1f}; told {dict(told)}"
            )
