"""Malformed frames, requests and messages: none may crash, hang, leak or take much."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Annotated
from urllib.parse import quote, urlsplit

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from experiments.service.fuzz_cases import CAMERA, RING, Cases
from experiments.service.fuzz_routes import Routes, raw_bytes, send_raw
from experiments.service.serving import Processes, Served
from rendezview_service.client import Client, ServiceError

SLOW_S = 10.0
MOST_PROCESSOR_S = 5.0  # of the service and its workers for one case; a whole search takes 1
MOST_MB = 200.0  # that their memory may take for one case at its peak, and grow by in all
MOST_HELD = 500  # half-open connections
SESSION = "fuzzed"  # most cases go there
_PATHS = (
    "/v1/sessions", "/v1/sessions/{}", "/v1/sessions/{}/state?as={}", "/v1/models/{}",
    "/v1/sessions/{}/history?seconds={}&limit={}", "/v1/sessions/{}/images/{}", "/{}",
    "/v1/sessions/{}/log", "/v1/models/{}/geometry", "/v1/jobs/{}", "/v1/sessions/{}/{}",
    "/v1/sessions/{}/contour/{}",
)  # fmt: skip


class Fuzz(Cases):
    """Sends the cases and notes what must not be."""

    def __init__(self, served: Processes, seed: int) -> None:
        super().__init__(seed)
        self.served = served
        self.outcomes: Counter[str] = Counter()
        self.failures: list[str] = []
        self.told = 0  # of them
        self.place = urlsplit(served.url)
        self.held: list[socket.socket] = []
        self.part = ""  # what it does, for the progress
        self.worst_s: dict[str, tuple[float, str]] = {}  # of a case of each part, and what it was
        self.worst_mb: dict[str, tuple[float, str]] = {}

    def ask(
        self,
        http: HTTPConnection,
        method: str,
        path: str,
        body: bytes | None,
        headers: dict[str, str] | None = None,
    ) -> bytes:
        """One request; what must not be is noted."""
        start = time.monotonic()
        content = b""
        try:
            http.request(method, path, body, headers or {})
            with http.getresponse() as answer:
                content = answer.read()
            self.outcomes[str(answer.status)] += 1
            if answer.status >= 500 and answer.status != 503:
                self.failures.append(f"{method} {path}: {answer.status} {content[:200]!r}")
        except (OSError, HTTPException, ValueError) as error:  # ValueError: http.client refuses
            http.close()
            self.outcomes[type(error).__name__] += 1
            if isinstance(error, TimeoutError):
                self.failures.append(f"{method} {path}: no answer")
        if time.monotonic() - start > SLOW_S:
            self.failures.append(f"{method} {path}: took {time.monotonic() - start:.1f} s")
        return content

    def by_http(self, count: int) -> None:
        """Frames and requests, some good ones between."""
        http = HTTPConnection(self.place.hostname or "", self.place.port, timeout=30.0)
        for k in range(count):
            self.measured(lambda: self.http_case(http))
            if k % 1000 == 999:
                self.progress(k + 1)
                self.still_tracks()
        self.let_go()
        http.close()

    def http_case(self, http: HTTPConnection) -> str:
        """One case; what it was."""
        rng, session, what = self.rng, SESSION, self.rng.random()
        if what < 0.25:
            sensor, lines = self.lines()
            path = f"/v1/sessions/{session}/measurements?sensor={quote(sensor)}"
            self.ask(http, "POST", path, lines)
            return f"lines {lines[:80]!r}"
        if what < 0.6:
            time_s = "" if rng.random() < 0.9 else f"?time_s={quote(str(self.value()))}"
            frame = self.frame()
            self.ask(http, "POST", f"/v1/sessions/{session}/frames{time_s}", frame)
            return f"frame {frame[:40]!r}"
        if what < 0.8:
            asked = self.request_of_session()
            body = self.ask(http, "POST", "/v1/sessions", asked)
            opened = json.loads(body).get("id") if body.startswith(b'{"id"') else None
            if opened:
                self.ask(http, "POST", f"/v1/sessions/{opened}/frames", self.frame())
                self.ask(http, "DELETE", f"/v1/sessions/{opened}", None)
            return f"session {asked[:200]!r}"
        if what < 0.97:
            words = [quote(str(self.value())[:200], safe="") for _ in range(3)]
            words[0] = session if rng.random() < 0.5 else words[0]
            methods = ("GET", "DELETE", "PUT", "POST", "PATCH", "HEAD")
            method = "GET" if rng.random() < 0.7 else str(rng.choice(methods))
            path = str(rng.choice(_PATHS)).format(*words)
            if method == "DELETE" and path == f"/v1/sessions/{session}":
                method = "GET"
            self.ask(http, method, path, self.frame() if method in ("PUT", "POST") else None)
            return f"{method} {path}"
        content = raw_bytes(rng)
        self.raw(content)
        return repr(content[:80])

    def progress(self, count: int) -> None:
        """Say how far it is."""
        told = f"{count} cases, {len(self.failures)} failures, {self.served.resident_mb():.0f} MB"
        print(f"{self.part}: {told}", file=sys.stderr, flush=True)
        for failure in self.failures[self.told :]:
            print(failure[:300], file=sys.stderr, flush=True)
        self.told = len(self.failures)

    def raw(self, content: bytes) -> None:
        """Bytes to the socket; connections that wait for more stay open for a while."""
        address = (self.place.hostname or "", self.place.port or 0)
        self.outcomes[send_raw(address, content, self.held)] += 1
        if len(self.held) > MOST_HELD:
            self.let_go()

    def let_go(self) -> None:
        """Close the connections that wait."""
        for connection in self.held:
            connection.close()
        self.held.clear()

    def measured(self, case: Callable[[], str]) -> None:
        """One case, with the processor time and the peak of memory that it took."""
        self.served.forget_peak()
        before_s, before_mb = self.served.processor_s(), self.served.resident_mb()
        what = case()[:300]
        spent_s, grew_mb = self.served.processor_s() - before_s, self.served.peak_mb() - before_mb
        self.worst_s[self.part] = max(self.worst_s.get(self.part, (0.0, "")), (spent_s, what))
        self.worst_mb[self.part] = max(self.worst_mb.get(self.part, (0.0, "")), (grew_mb, what))
        if spent_s > MOST_PROCESSOR_S:
            self.failures.append(f"{what}: {spent_s:.1f} s of processor time")
        if grew_mb > MOST_MB:
            self.failures.append(f"{what}: memory grew by {grew_mb:.0f} MB")

    def by_routes(self, count: int) -> None:
        """Every route with every method, and bytes that are no request."""
        http = HTTPConnection(self.place.hostname or "", self.place.port, timeout=30.0)
        http.request("GET", "/openapi.json")
        routes = Routes(json.loads(http.getresponse().read()), self.rng, self.value)
        self.still_tracks()

        def case() -> str:
            if self.rng.random() < 0.2:
                content = raw_bytes(self.rng)
                self.raw(content)
                return repr(content[:80])
            asked = routes.request(SESSION, self.frame)
            self.ask(http, *asked)
            return f"{asked[0]} {asked[1]}"

        for k in range(count):
            self.measured(case)
            if k % 1000 == 999:
                self.progress(k + 1)
                self.still_tracks()
        self.let_go()
        http.close()

    def by_stream(self, count: int) -> None:
        """Messages into a stream; each has an answer, or was dropped for the next one."""
        url = self.served.url.replace("http", "ws") + f"v1/sessions/{SESSION}/stream"
        left = count
        while left:
            before = left
            try:
                with connect(url, compression=None, max_size=None) as stream:
                    for _ in range(min(left, 500)):
                        left -= 1
                        self.measured(lambda: self.stream_case(stream))
            except TimeoutError:
                self.failures.append("stream: no answer")
            except (WebSocketException, OSError) as error:
                self.outcomes[f"stream {type(error).__name__}"] += 1
            if left // 1000 != before // 1000:
                self.progress(count - left)
                self.still_tracks()

    def stream_case(self, stream: ClientConnection) -> str:
        """One message and its answer; what it was."""
        head = struct.pack("<d", float("nan"))
        if self.rng.random() < 0.2:
            head = self.rng.bytes(self.rng.integers(0, 9))
        message: bytes | str = head + self.frame()
        if self.rng.random() < 0.05:
            message = json.dumps(self.value())
        elif self.rng.random() < 0.2:
            asked = {"sensor": self.value(), "record": self.value()}
            if self.rng.random() < 0.8:
                asked["sensor"] = str(self.rng.choice(["rim", "laser", "mirrors"]))
            message = json.dumps(asked)
            if self.rng.random() < 0.8:
                sensor, lines = self.lines()
                line = lines.decode(errors="replace").split("\n")[0]
                message = f'{{"sensor": "{sensor}", "record": {line}}}'
        stream.send(message)
        answer = json.loads(stream.recv(SLOW_S))
        status = answer.get("status", 200)
        self.outcomes[f"stream {status if 'error' in answer else 'state'}"] += 1
        if "error" in answer and status >= 500 and status != 503:
            self.failures.append(f"stream: {answer}")
        return f"message {message[:80]!r}"

    def open(self, client: Client) -> None:
        """The session that the cases go to."""
        client.open(CAMERA, name=SESSION, fusion={"ring": RING}, idle_s=3600.0)

    def still_tracks(self) -> None:
        """A good frame in a new session, and none that stays; the session of the cases is open."""
        with Client(self.served.url) as client:
            if SESSION not in [session["id"] for session in client.sessions()]:
                self.failures.append("the session of the cases has ended")
                self.open(client)
            session = client.open(CAMERA)
            try:
                session.track(np.frombuffer(self.good[0], np.uint8).reshape(120, 160), 1.0)
            except ServiceError as error:
                self.failures.append(f"a good frame is refused: {error}")
            session.close()


def run(
    model: Path, *, count: int = 50000, seed: int = 0,
    schemathesis: Annotated[str | None, "its command, such as .st/bin/schemathesis"] = None,
    examples: Annotated[int, "of schemathesis, each route"] = 100,
) -> None:  # fmt: skip
    """Malformed frames and messages, by the ten thousand: none may crash, hang or leak.

    Half of the cases go to every route with every method, and to the socket itself; a quarter are
    damaged frames of all kinds, lines of other sensors and JSON that is almost right, by HTTP; a
    quarter the same by WebSocket. Failures: a server error (5xx other than 503), an answer that
    takes more than 10 s, more than 5 s of processor time or 200 MB for a case, a worker that ends,
    a session that remains, or a service that no longer tracks a good frame. --schemathesis
    (installed apart) adds cases made from the OpenAPI description.
    """
    served = Served(model, spare_worker="false")
    served.await_ready()
    fuzz = Fuzz(served, seed)
    with Client(served.url) as client:
        fuzz.open(client)
        fuzz.still_tracks()
        before = served.resident_mb()
        start = time.monotonic()
        parts = {fuzz.by_routes: count // 2, fuzz.by_http: count // 4}
        parts[fuzz.by_stream] = count - sum(parts.values())
        for part, share in parts.items():
            if share:
                fuzz.part = part.__name__
                part(share)
        fuzz.still_tracks()
        spent = time.monotonic() - start
        sessions = [s["id"] for s in client.sessions()]
        metrics = client.fetch("GET", "/metrics").decode()
        restarts = next(
            float(line.split()[-1])
            for line in metrics.splitlines()
            if line.startswith("rendezview_worker_restarts_total")
        )
        after = served.resident_mb()
    code = 0
    if schemathesis:
        code = subprocess.run(
            [
                schemathesis, "run", f"{served.url}openapi.json", "--checks",
                "not_a_server_error", "--max-examples", str(examples), "--seed",
                str(seed), "--request-timeout", "30",
            ],
            check=False,
        ).returncode  # fmt: skip
    served.stop()
    if sessions != [SESSION]:
        fuzz.failures.append(f"sessions stay: {sessions}")
    if after - before > MOST_MB:
        fuzz.failures.append(f"memory grew by {after - before:.0f} MB in all")
    if restarts:
        fuzz.failures.append(f"{restarts:.0f} workers ended")
    cases = f"seed {seed}: {count} cases in {spent:.0f} s"
    print(f"{cases}, {len(fuzz.failures)} failures")
    print(", ".join(f"{name}: {count}" for name, count in fuzz.outcomes.most_common()))
    print(f"memory {before:.0f} MB before, {after:.0f} MB after; {restarts:.0f} workers ended")
    for part in fuzz.worst_s:
        (spent_s, slow), (grew_mb, large) = fuzz.worst_s[part], fuzz.worst_mb[part]
        print(f"{part}: most for one case {spent_s:.2f} s of processor time ({slow})")
        print(f"{part}: most memory for one case {grew_mb:.0f} MB ({large})")
    for failure in fuzz.failures[:20]:
        print(failure)
    if fuzz.failures:
        print("\n".join(["the service's last lines:", *served.log[-40:]]))
    sys.exit(bool(fuzz.failures or code))
