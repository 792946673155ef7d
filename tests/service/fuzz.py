"""Malformed frames, requests and messages: none may crash, hang, leak or take much.

Of test_fuzz.py, and by the ten thousand of experiment service-faults.
"""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from urllib.parse import quote, urlsplit

import numpy as np
from tests.service.fuzz_cases import CAMERA, RING, Cases
from tests.service.fuzz_routes import Routes, raw_bytes, send_raw
from tests.service.served import Served
from tests.waiting import MOST_S
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from rendezview_service.client import Client, ServiceError

MOST_PROCESSOR_S = 5.0  # of the service and its workers for one case; a whole search takes 1
MOST_MB = 200.0  # that their memory may take for one case at its peak, and grow by in all
MOST_HELD = 500  # half-open connections
CHECKED_EVERY = 1000  # cases
PEAK_EVERY = 20  # cases, between looks at the peak of memory, which cost more than a case
PARTS = {"by_routes": 18, "by_http": 1, "by_stream": 1}  # shares of the cases
SESSION = "fuzzed"  # most cases go there
RESTARTS = b"rendezview_worker_restarts_total 0.0"  # in the metrics, where no worker has ended


def forget_peak(pids: list[int]) -> None:
    """`peak_mb` begins again. Source: the kernel's `proc(5)`, clear_refs."""
    for pid in pids:
        with contextlib.suppress(OSError):  # it has ended
            Path(f"/proc/{pid}/clear_refs").write_text("5")


def peak_mb(pids: list[int]) -> float:
    """Of these processes: the most since `forget_peak`, each at its own time."""
    kilobytes = 0
    for pid in pids:
        with contextlib.suppress(OSError, StopIteration):
            lines = Path(f"/proc/{pid}/status").read_text().splitlines()
            kilobytes += int(next(li for li in lines if li.startswith("VmHWM")).split()[1])
    return kilobytes * 1024 / 1e6


class Fuzz(Cases):
    """Sends the cases and notes what must not be."""

    def __init__(self, served: Served, seed: int) -> None:
        super().__init__(seed)
        self.served = served
        self.outcomes: Counter[str] = Counter()
        self.failures: list[str] = []
        self.place = urlsplit(served.url)
        self.held: list[socket.socket] = []
        self.worst_s: tuple[float, str] = (0.0, "")  # of a case, and what it was
        self.worst_mb: tuple[float, str] = (0.0, "")
        self._cases: list[str] = []  # since the peak of memory was noted
        self._resident_mb = served.resident_mb()
        forget_peak(served.pids())

    def ask(
        self, http: HTTPConnection, method: str, path: str, body: bytes | None,
        headers: dict[str, str] | None = None,
    ) -> bytes:  # fmt: skip
        """One request; what must not be is noted."""
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
        return content

    def measured(self, case: Callable[[], str]) -> None:
        """One case, with the processor time that it took; the peak of memory is of many cases."""
        before_s = self.served.processor_s()
        what = case()[:300]
        spent_s = self.served.processor_s() - before_s
        self.worst_s = max(self.worst_s, (spent_s, what))
        if spent_s > MOST_PROCESSOR_S:
            self.failures.append(f"{what}: {spent_s:.1f} s of processor time")
        self._cases.append(what)
        if len(self._cases) >= PEAK_EVERY:
            self.note_peak()

    def note_peak(self) -> None:
        """The peak of memory since the last one, above what was there then."""
        grew_mb = peak_mb(self.served.pids()) - self._resident_mb
        self.worst_mb = max(self.worst_mb, (grew_mb, " | ".join(self._cases)[:300]))
        if grew_mb > MOST_MB:
            self.failures.append(f"{grew_mb:.0f} MB more in one of {self._cases}")
        self._cases.clear()
        forget_peak(self.served.pids())
        self._resident_mb = self.served.resident_mb()

    def by_http(self, count: int, case: Callable[[HTTPConnection], str] | None = None) -> None:
        """Frames, lines of sensors and requests of sessions; or other cases."""
        http = HTTPConnection(self.place.hostname or "", self.place.port, timeout=MOST_S)
        for k in range(count):
            self.measured(lambda: (case or self.http_case)(http))
            if k % CHECKED_EVERY == CHECKED_EVERY - 1:
                self.still_tracks()
        self.let_go()
        http.close()

    def http_case(self, http: HTTPConnection) -> str:
        """One case; what it was."""
        what = self.rng.random()
        if what < 0.3:
            sensor, lines = self.lines()
            path = f"/v1/sessions/{SESSION}/measurements?sensor={quote(sensor)}"
            self.ask(http, "POST", path, lines)
            return f"lines {lines[:80]!r}"
        if what < 0.7:
            time_s = "" if self.rng.random() < 0.9 else f"?time_s={quote(str(self.value()))}"
            frame = self.frame()
            self.ask(http, "POST", f"/v1/sessions/{SESSION}/frames{time_s}", frame)
            return f"frame {frame[:40]!r}"
        asked = self.request_of_session()
        body = self.ask(http, "POST", "/v1/sessions", asked)
        opened = json.loads(body).get("id") if body.startswith(b'{"id"') else None
        if opened:
            self.ask(http, "POST", f"/v1/sessions/{opened}/frames", self.frame())
            self.ask(http, "DELETE", f"/v1/sessions/{opened}", None)
        return f"session {asked[:200]!r}"

    def by_routes(self, count: int) -> None:
        """Every route with every method, and bytes that are no request."""
        with Client(self.served.url) as client:
            description = json.loads(client.fetch("GET", "/openapi.json"))
        routes = Routes(description, self.rng, self.value)
        address = (self.place.hostname or "", self.place.port or 0)

        def case(http: HTTPConnection) -> str:
            if self.rng.random() < 0.2:
                content = raw_bytes(self.rng)
                self.outcomes[send_raw(address, content, self.held)] += 1
                if len(self.held) > MOST_HELD:
                    self.let_go()
                return repr(content[:80])
            asked = routes.request(SESSION, self.frame)
            self.ask(http, *asked)
            return f"{asked[0]} {asked[1]}"

        self.by_http(count, case)

    def let_go(self) -> None:
        """Close the connections that wait."""
        for connection in self.held:
            connection.close()
        self.held.clear()

    def by_stream(self, count: int) -> None:
        """Messages into a stream; each has an answer, or was dropped for the next one."""
        url = self.served.url.replace("http", "ws") + f"v1/sessions/{SESSION}/stream"
        left = count
        while left:
            try:
                with connect(url, compression=None, max_size=None) as stream:
                    for _ in range(min(left, CHECKED_EVERY)):
                        left -= 1
                        self.measured(lambda: self.stream_case(stream))
                self.still_tracks()
            except TimeoutError:
                self.failures.append("stream: no answer")
            except (WebSocketException, OSError) as error:
                self.outcomes[f"stream {type(error).__name__}"] += 1

    def stream_case(self, stream: ClientConnection) -> str:
        """One message and its answer; what it was."""
        rng, message = self.rng, b""
        head = struct.pack("<d", float("nan"))
        if rng.random() < 0.2:
            head = rng.bytes(rng.integers(0, 9))
        elif rng.random() < 0.1:
            head = json.dumps({"time_s": self.value(), "roi": self.value()}).encode() + b"\n"
        message = head + self.frame()
        if rng.random() < 0.05:
            message = json.dumps(self.value())
        elif rng.random() < 0.2:
            sensor, lines = self.lines()
            line = lines.decode(errors="replace").split("\n")[0]
            message = f'{{"sensor": "{sensor}", "record": {line}}}'
            if rng.random() < 0.2:
                message = json.dumps({"sensor": sensor, "record": self.value()})
        stream.send(message)
        answer = json.loads(stream.recv(MOST_S))
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


def campaign(
    served: Served, seed: int, count: int, *, block: int = 2000, minutes: float = 600.0
) -> Fuzz:
    """So many cases of all kinds, in blocks; none begins after so many minutes.

    Most cases go to every route with every method, pictures among them, and to the socket itself;
    the others are damaged frames, lines of other sensors or JSON that is almost right, by HTTP and
    by WebSocket: these cost a search each. Failures: a server error (5xx other than 503), an answer
    that takes more than 10 s, more than 5 s of processor time or 200 MB for a case, a worker that
    ends, a session that remains, or a service that no longer tracks a good frame.
    """
    fuzz, start_s, done = Fuzz(served, seed), time.monotonic(), 0
    with served.client() as client:
        fuzz.open(client)
        fuzz.still_tracks()
        before_mb = served.resident_mb()
        while done < count and time.monotonic() < start_s + 60.0 * minutes:
            for part, share in PARTS.items():
                cases = block * share // sum(PARTS.values())
                getattr(fuzz, part)(cases)
                done += cases
            fuzz.still_tracks()
            print(f"{done} cases, {len(fuzz.failures)} failures, {served.resident_mb():.0f} MB",
                  file=sys.stderr, flush=True)  # fmt: skip
        if (sessions := [one["id"] for one in client.sessions()]) != [SESSION]:
            fuzz.failures.append(f"sessions stay: {sessions}")
        if RESTARTS not in client.fetch("GET", "/metrics"):
            fuzz.failures.append("workers ended")
    if (after_mb := served.resident_mb()) - before_mb > MOST_MB:
        fuzz.failures.append(f"memory grew by {after_mb - before_mb:.0f} MB in all")
    spent_s = time.monotonic() - start_s
    print(f"seed {seed}: {done} cases in {spent_s:.0f} s, {len(fuzz.failures)} failures")
    print(", ".join(f"{name}: {count}" for name, count in fuzz.outcomes.most_common()))
    print(f"memory {before_mb:.0f} MB before, {after_mb:.0f} MB after")
    print(f"most for one case {fuzz.worst_s[0]:.2f} s of processor time ({fuzz.worst_s[1]})")
    print(f"most memory for one case {fuzz.worst_mb[0]:.0f} MB ({fuzz.worst_mb[1]})")
    print(*fuzz.failures[:20], sep="\n")
    return fuzz
