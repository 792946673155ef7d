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
from typing import Annotated, Any
from urllib.parse import quote, urlsplit

import cv2
import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from experiments.service.fuzz_routes import Routes, raw_bytes, send_raw
from experiments.service.serving import Processes, Served
from rendezview.client import Client, ServiceError
from rendezview.geometry.camera import Camera

CAMERA = Camera.from_fov(160, 120, np.deg2rad(40.0))
SLOW_S = 10.0
MOST_PROCESSOR_S = 1.0  # of the service and its workers, for one case
MOST_MB = 200.0  # that their memory may grow
MOST_HELD = 500  # half-open connections


RING = {"centre_m": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "radius_m": 0.5}
_POSE = {"quat_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [0.0, 0.0, 9.0]}
LINES: dict[str, dict[str, Any]] = {
    "mirrors": {"pose": _POSE, "covariance": (1e-4 * np.eye(6)).tolist(), "roll_ambiguous": False,
     "spots": [{"x_px": 10.0, "y_px": 20.0}]},
    "ring": {"ellipses": [{"centre_px": [80.0, 60.0], "semi_axes_px": [9.0, 8.0],
                           "angle_rad": 0.1}], "ellipse": 0,
             "poses": [{"centre_m": [0.0, 0.0, 9.0], "axis": [0.0, 0.0, -1.0],
                        "covariance": (1e-4 * np.eye(5)).tolist()}]},
    "laser": {"range_m": 9.0, "sigma_m": 0.02,
              "origin_m": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 1.0]},
}  # fmt: skip


class Fuzz:
    """Cases drawn from one generator, so that a seed repeats them."""

    def __init__(self, served: Processes, seed: int) -> None:
        self.served = served
        self.rng = np.random.default_rng(seed)
        self.outcomes: Counter[str] = Counter()
        self.failures: list[str] = []
        self.place = urlsplit(served.url)
        self.held: list[socket.socket] = []
        self.worst_s = 0.0
        self.start_mb = self.most_mb = 0.0
        noise = self.rng.integers(0, 255, (120, 160), dtype=np.uint8)
        blob = noise // 16
        blob[30:90, 40:110] |= 128
        self.good = [
            blob.tobytes(),
            *(cv2.imencode(s, i)[1].tobytes() for s in (".png", ".jpg") for i in (blob, noise)),
            cv2.imencode(".png", np.zeros((120, 160, 3), np.uint8))[1].tobytes(),
            cv2.imencode(".png", np.zeros((120, 160), np.uint16))[1].tobytes(),
            cv2.imencode(".png", np.zeros((50, 60), np.uint8))[1].tobytes(),
        ]

    def frame(self) -> bytes:
        """A frame that was good before something happened to it."""
        rng = self.rng
        content = bytearray(self.good[rng.integers(len(self.good))])
        for _ in range(rng.integers(1, 4)):
            how = rng.integers(7)
            if how == 0:
                content = content[: rng.integers(0, len(content) + 1)]
            elif how == 1 and content:
                for place in rng.integers(0, len(content), rng.integers(1, 30)):
                    content[place] = rng.integers(256)
            elif how == 2 and len(content) > 40:  # in the header
                content[rng.integers(0, 40)] = rng.integers(256)
            elif how == 3:
                place = rng.integers(0, len(content) + 1)
                content[place:place] = rng.bytes(rng.integers(1, 50))
            elif how == 4 and len(content) > 24:  # another size than it has
                size = struct.pack(">II", *rng.integers(0, 2**31, 2))
                content[16:24] = size
            elif how == 5:
                content = bytearray(rng.bytes(rng.integers(0, 3000)))
            else:
                other = self.good[rng.integers(len(self.good))]
                content[len(content) // 2 :] = other[len(other) // 2 :]
        return bytes(content)

    def value(self, depth: int = 0) -> object:
        """Some JSON."""
        rng = self.rng
        simple = [
            None, True, 0, -1, 1.5, 1e308, -1e308, 2**63, 10**30, "", "x" * 300, "\u0000", "..",
            "../../etc/passwd", "bumpy", [], {}, [1, 2, 3], [[]], "nan", "\ud7ff", 640, 480, 1e-320,
        ]  # fmt: skip
        if depth < 3 and rng.random() < 0.3:
            if rng.random() < 0.5:
                return [self.value(depth + 1) for _ in range(rng.integers(0, 5))]
            return {str(self.value(3))[:20]: self.value(depth + 1) for _ in range(3)}
        return simple[rng.integers(len(simple))]

    def request_of_session(self) -> bytes:
        """A request that is almost right."""
        rng = self.rng
        names = ("width", "height", "fx", "fy", "cx", "cy")
        request: dict[str, object] = {
            "camera": {name: getattr(CAMERA, name) for name in names} | {"distortion": []},
            "id": None,
            "prior": {"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 9]},
            "sun_camera": [0, 0, -1],
            "fusion": {"ring": dict(RING), "surfaces": [], "options": {"history_s": 5.0}},
        }
        place: dict[str, object] = request
        if rng.random() < 0.5:
            place = request[str(rng.choice(["camera", "prior", "fusion"]))]  # type: ignore[assignment]
        place[str(rng.choice([*place, "more"]))] = self.value()
        text = json.dumps(request, allow_nan=True).encode()
        if rng.random() < 0.2:
            text = text[: rng.integers(len(text))] + rng.bytes(rng.integers(0, 4))
        return text

    def lines(self) -> tuple[str, bytes]:
        """A sensor, and lines of it that are almost right, at times that rise or do not."""
        rng = self.rng
        lines = []
        sensor = str(rng.choice(list(LINES)))
        for _ in range(rng.integers(1, 4)):
            line = json.loads(json.dumps(LINES[sensor]))
            line["time_s"] = time.time() + rng.normal()
            for _ in range(rng.choice([0, 0, 1, 2])):
                place = line
                while True:
                    keys = list(place) if isinstance(place, dict) else list(range(len(place)))
                    if not keys:
                        break
                    key = keys[rng.integers(len(keys))]
                    if isinstance(place[key], dict | list) and rng.random() < 0.7:
                        place = place[key]
                        continue
                    place[key] = self.value()
                    break
            lines.append(json.dumps(line, allow_nan=True).encode())
        text = bytearray(b"\n".join(lines))
        if rng.random() < 0.2:
            for at in rng.integers(0, len(text), rng.integers(1, 5)):
                text[at] = rng.integers(256)
        if rng.random() < 0.1:
            text = text[: rng.integers(len(text))]
        if rng.random() < 0.1:
            sensor = str(rng.choice(["ring", "laser", "camera", "x", "a b"]))
        return sensor, bytes(text)

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

    def by_http(self, count: int, session: str) -> None:
        """Frames and requests, some good ones between."""
        rng = self.rng
        http = HTTPConnection(self.place.hostname or "", self.place.port, timeout=30.0)
        paths = (
            "/v1/sessions", "/v1/sessions/{}", "/v1/sessions/{}/state?as={}", "/v1/models/{}",
            "/v1/sessions/{}/history?seconds={}&limit={}", "/v1/sessions/{}/images/{}", "/{}",
            "/v1/sessions/{}/log", "/v1/models/{}/geometry", "/v1/jobs/{}", "/v1/sessions/{}/{}",
            "/v1/sessions/{}/contour/{}",
        )  # fmt: skip
        for k in range(count):
            what = rng.random()
            if what < 0.25:
                sensor, lines = self.lines()
                path = f"/v1/sessions/{session}/measurements?sensor={quote(sensor)}"
                self.ask(http, "POST", path, lines)
            elif what < 0.6:
                time_s = "" if rng.random() < 0.9 else f"?time_s={quote(str(self.value()))}"
                self.ask(http, "POST", f"/v1/sessions/{session}/frames{time_s}", self.frame())
            elif what < 0.8:
                body = self.ask(http, "POST", "/v1/sessions", self.request_of_session())
                opened = json.loads(body).get("id") if body.startswith(b'{"id"') else None
                if opened:
                    self.ask(http, "POST", f"/v1/sessions/{opened}/frames", self.frame())
                    self.ask(http, "DELETE", f"/v1/sessions/{opened}", None)
            elif what < 0.97:
                words = [quote(str(self.value())[:200], safe="") for _ in range(3)]
                words[0] = session if rng.random() < 0.5 else words[0]
                methods = ("GET", "DELETE", "PUT", "POST", "PATCH", "HEAD")
                method = "GET" if rng.random() < 0.7 else str(rng.choice(methods))
                path = str(rng.choice(paths)).format(*words)
                if method == "DELETE" and path == f"/v1/sessions/{session}":
                    continue
                self.ask(http, method, path, self.frame() if method in ("PUT", "POST") else None)
            else:
                self.raw(raw_bytes(rng))
            if k % 1000 == 999:
                self.still_tracks()
        self.let_go()
        http.close()

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

    def measured(self, what: str, case: Callable[[], None]) -> None:
        """One case, with the processor time and memory that it took."""
        before_s = self.served.processor_s()
        case()
        spent_s = self.served.processor_s() - before_s
        self.worst_s = max(self.worst_s, spent_s)
        if spent_s > MOST_PROCESSOR_S:
            self.failures.append(f"{what}: {spent_s:.1f} s of processor time")
        now_mb = self.served.resident_mb()
        if now_mb > self.most_mb:
            self.most_mb = now_mb
            if now_mb - self.start_mb > MOST_MB:
                self.failures.append(f"{what}: memory grew by {now_mb - self.start_mb:.0f} MB")

    def by_routes(self, count: int, session: str) -> None:
        """Every route with every method, and bytes that are no request."""
        http = HTTPConnection(self.place.hostname or "", self.place.port, timeout=30.0)
        http.request("GET", "/openapi.json")
        routes = Routes(json.loads(http.getresponse().read()), self.rng, self.value)
        self.still_tracks()
        self.start_mb = self.most_mb = self.served.resident_mb()
        for k in range(count):
            if self.rng.random() < 0.2:
                content = raw_bytes(self.rng)
                self.measured(repr(content[:80]), lambda: self.raw(content))  # noqa: B023
            else:
                asked = routes.request(session, self.frame)
                self.measured(
                    f"{asked[0]} {asked[1][:200]}",
                    lambda: void(self.ask(http, *asked)),  # noqa: B023
                )
            if k % 1000 == 999:
                self.still_tracks()
        self.let_go()
        http.close()

    def by_stream(self, count: int, session: str) -> None:
        """Messages into a stream; each has an answer, or was dropped for the next one."""
        url = self.served.url.replace("http", "ws") + f"v1/sessions/{session}/stream"
        left = count
        while left:
            try:
                with connect(url, compression=None, max_size=None) as stream:
                    for _ in range(min(left, 500)):
                        left -= 1
                        head = struct.pack("<d", float("nan"))
                        if self.rng.random() < 0.2:
                            head = self.rng.bytes(self.rng.integers(0, 9))
                        message: bytes | str = head + self.frame()
                        if self.rng.random() < 0.05:
                            message = json.dumps(self.value())
                        elif self.rng.random() < 0.2:
                            answer = {"sensor": self.value(), "record": self.value()}
                            if self.rng.random() < 0.8:
                                answer["sensor"] = str(
                                    self.rng.choice(["ring", "laser", "mirrors"])
                                )
                            message = json.dumps(answer)
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
            except TimeoutError:
                self.failures.append("stream: no answer")
            except (WebSocketException, OSError) as error:
                self.outcomes[f"stream {type(error).__name__}"] += 1

    def still_tracks(self) -> None:
        """A good frame in a new session, and none that stays."""
        with Client(self.served.url) as client:
            session = client.open(CAMERA)
            try:
                session.track(np.frombuffer(self.good[0], np.uint8).reshape(120, 160), 1.0)
            except ServiceError as error:
                self.failures.append(f"a good frame is refused: {error}")
            session.close()


def void(_: object) -> None:
    """For a result that does not matter."""


def run(
    model: Path, *, count: int = 50000, seed: int = 0,
    schemathesis: Annotated[str | None, "its command, such as .st/bin/schemathesis"] = None,
    examples: Annotated[int, "of schemathesis, each route"] = 100,
) -> None:  # fmt: skip
    """Malformed frames and messages, by the ten thousand: none may crash, hang or leak.

    Half of the cases go to every route with every method, and to the socket itself; a quarter are
    damaged frames of all kinds, lines of other sensors and JSON that is almost right, by HTTP; a
    quarter the same by WebSocket. Failures: a server error (5xx other than 503), an answer that
    takes more than 10 s, more than 1 s of processor time or 200 MB for a case, a worker that ends,
    a session that remains, or a service that no longer tracks a good frame. --schemathesis
    (installed apart) adds cases made from the OpenAPI description.
    """
    served = Served(model, spare_worker="false")
    fuzz = Fuzz(served, seed)
    with Client(served.url) as client:
        session = client.open(CAMERA, name="fuzzed", fusion={"ring": RING}, idle_s=3600.0)
        before = served.resident_mb()
        start = time.monotonic()
        if count:
            fuzz.by_routes(count // 2, "fuzzed")
            fuzz.by_http(count // 4, "fuzzed")
            fuzz.by_stream(count - count // 2 - count // 4, "fuzzed")
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
        session.close()
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
    if sessions != ["fuzzed"]:
        fuzz.failures.append(f"sessions stay: {sessions}")
    if restarts:
        fuzz.failures.append(f"{restarts:.0f} workers ended")
    cases = f"seed {seed}: {count} cases in {spent:.0f} s"
    print(f"{cases}, {len(fuzz.failures)} failures")
    print(", ".join(f"{name}: {count}" for name, count in fuzz.outcomes.most_common()))
    print(f"memory {before:.0f} MB before, {after:.0f} MB after; {restarts:.0f} workers ended")
    print(f"most for one case of the routes: {fuzz.worst_s:.2f} s of processor time")
    for failure in fuzz.failures[:20]:
        print(failure)
    sys.exit(bool(fuzz.failures or code))
