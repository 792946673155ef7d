"""The client of the pose service.

    with Client("http://127.0.0.1:8360") as client:
        with client.open(camera) as session:
            state = session.track(image, time_s)

A `StateDict` is the service's `State` message, key by key. `pose_of_state` and ``numpy.array``
convert its pose and covariance to the types of this package.
"""

from __future__ import annotations

import json
import re
import secrets
import ssl
import threading
import time
from collections.abc import Mapping
from http.client import (
    HTTPConnection,
    HTTPException,
    HTTPResponse,
    HTTPSConnection,
    IncompleteRead,
)
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.files import read_bytes, read_text
from rendezview.io.results import json_line
from rendezview_service.client.messages import (
    Frame,
    ServiceError,
    StateDict,
    camera_message,
    frame_content,
    frame_query,
)
from rendezview_service.client.stream import PAUSE_S, StreamClient

_FITS_HEADER = re.compile(r"[\x21-\x7e]+")
_IDLE_S = 30.0  # s; the service may have closed an idle connection. Source: chosen


class Client:
    """One connection to a service. Requests of threads that share it follow one another."""

    def __init__(
        self,
        url: str,
        token: str | None = None,
        timeout_s: float = 30.0,
        certificate: Path | str | None = None,
        reconnect_s: float = 10.0,
        sender: str | None = None,
    ) -> None:
        """A client; it connects with the first request.

        Args:
            timeout_s: a request ends with an error when the service is silent for so long.
            certificate: PEM file of the authority to trust, if the system does not trust the
                service's certificate (``https``).
            reconnect_s: for how long a service that was reached before is tried again, when it
                does not answer or asks to wait.
            sender: who sends frames; a client that takes over from another one gives its name.

        Raises:
            RendezviewError: the address is wrong, or the certificate cannot be read.
        """
        try:
            parts = urlsplit(url)
            known = parts.scheme in ("http", "https") and parts.hostname and (parts.port or True)
        except ValueError:
            known = False
        if not known or (token is not None and not _FITS_HEADER.fullmatch(token)):
            what = "give the service as http://host:port"
            raise RendezviewError(f"{url}: {'a token has no spaces' if known else what}")
        self._url = parts
        assert parts.hostname is not None
        self._reconnect_s, self._timeout_s = reconnect_s, timeout_s
        self._reached = False
        self._tls = _tls(certificate) if parts.scheme == "https" else None
        self._connection: HTTPConnection = (
            HTTPConnection(parts.hostname, parts.port, timeout=timeout_s)
            if self._tls is None
            else HTTPSConnection(parts.hostname, parts.port, timeout=timeout_s, context=self._tls)
        )
        self._used_s = 0.0
        self._lock = threading.Lock()  # of the connection
        self._headers = {"X-Sender": sender or secrets.token_hex(8)}  # frames of two would mix
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"

    def open(
        self,
        camera: Camera | None = None,
        *,
        model: str | None = None,
        prior: Pose | None = None,
        sun_camera: npt.ArrayLike | None = None,
        roi: npt.ArrayLike | None = None,
        trees: bool = True,
        name: str | None = None,
        record: bool | None = None,
        fusion: Mapping[str, Any] | None = None,
        sensors: Mapping[str, Any] | None = None,
        approach: Mapping[str, Any] | None = None,
        idle_s: float | None = None,
    ) -> SessionClient:
        """Open a session; the service has defaults for all arguments. Use it in a ``with``.

        Args:
            roi: where the target is until there is a pose: a box (4,) x, y, width, height, px, a
                place on it (2,), or that and its range (3,) x, y, m.
            idle_s: without a frame for longer, the service ends the session (60 s).
            fusion: data on sensors, as in `FusionRequest`: ``ring`` (a `DockingRing`),
                ``reflectors`` (each a `Reflector`), ``surfaces``, ``mounts`` (a `Pose` by sensor
                name), ``options``.
            sensors: what runs on the frames, as in `FrameSensorsRequest`: ``ring``,
                ``reflectors``, ``trajectory``, ``fusion``.
            approach: docking port, corridor, limits and more, as in `ApproachRequest`.

        Raises:
            RendezviewError: the service cannot be reached, or refuses.
        """
        request: dict[str, Any] = {"id": name, "model": model, "trees": trees, "record": record}
        if idle_s is not None:
            request["idle_s"] = idle_s
        if camera is not None:
            request["camera"] = camera_message(camera)
        if prior is not None:
            request["prior"] = prior.as_dict()
        for key, numbers in (("sun_camera", sun_camera), ("roi", roi)):
            if numbers is not None:
                request[key] = np.asarray(numbers, dtype=np.float64).tolist()
        given = {"fusion": fusion, "sensors": sensors, "approach": approach}
        request |= {key: json.loads(json_line(value)) for key, value in given.items() if value}
        info = self.request("POST", "/v1/sessions", json.dumps(request).encode())
        return SessionClient(self, info["id"])

    def session(self, name: str) -> SessionClient:
        """A session that is already open."""
        return SessionClient(self, name)

    def sessions(self) -> list[dict[str, Any]]:
        """All sessions."""
        found: list[dict[str, Any]] = self.request("GET", "/v1/sessions")["sessions"]
        return found

    def send_model(self, name: str, path: Path | str) -> dict[str, Any]:
        """Upload a model file; its `ModelInfo`."""
        content = read_bytes(path, "a model file (*.rvm)")
        kind = "application/octet-stream"
        info: dict[str, Any] = self.request("PUT", f"/v1/models/{quote(name)}", content, kind)
        return info

    def train(
        self,
        name: str,
        mesh: Path | str,
        unit: str | None = None,
        camera: Path | str | None = None,
        **options: int,
    ) -> dict[str, Any]:
        """Upload a mesh and train a model of it, for a camera (file); the `JobInfo`.

        Without a unit it is that of the file, else metres.
        """
        query: dict[str, object] = {"model": name, "file": Path(mesh).name, **options}
        query |= {} if unit is None else {"unit": unit}
        if camera is not None:
            query["camera"] = read_text(camera, "a camera file")
        path = f"/v1/jobs?{urlencode(query)}"
        content = read_bytes(mesh, "a mesh file")
        job: dict[str, Any] = self.request("POST", path, content, "application/octet-stream")
        return job

    def job(self, job_id: str) -> dict[str, Any]:
        """A training job and its progress."""
        job: dict[str, Any] = self.request("GET", f"/v1/jobs/{quote(job_id)}")
        return job

    def request(
        self,
        method: str,
        path: str,
        body: bytes | memoryview | None = None,
        kind: str = "application/json",
    ) -> Any:
        """Send one request; the JSON of its answer.

        Raises:
            ServiceError: the service refuses.
            RendezviewError: the service cannot be reached.
        """
        content = self.fetch(method, path, body, kind)
        try:
            return json.loads(content) if content else None
        except ValueError:
            raise RendezviewError(
                f"{self._url.geturl()}: the answer is not JSON: is this the pose service?"
            ) from None

    def fetch(
        self,
        method: str,
        path: str,
        body: bytes | memoryview | None = None,
        kind: str = "application/json",
    ) -> bytes:
        """Send one request; the bytes of its answer. Errors as in `request`."""
        headers = self._headers if body is None else self._headers | {"Content-Type": kind}
        if method == "POST":  # received twice, it is done once
            headers = headers | {"Idempotency-Key": secrets.token_hex(16)}
        with self._lock:
            try:
                response, content = self._send_again(method, path, body, headers)
            except (OSError, HTTPException, ValueError) as error:
                self._connection.close()  # before another thread uses it
                raise RendezviewError(
                    f"{self._url.geturl()}: the service cannot be reached ({error}): is it running?"
                ) from None
        if response.status >= 400:
            try:
                message = str(json.loads(content)["error"])
            except (ValueError, KeyError, TypeError):
                message = f"the service answers {response.status} {response.reason}"
            raise ServiceError(message, response.status)
        return content

    def _send_again(
        self, method: str, path: str, body: bytes | memoryview | None, headers: dict[str, str]
    ) -> tuple[HTTPResponse, bytes]:
        """An answer, from a new connection if the old one was closed.

        An idle connection may be closed meanwhile, or the service may start again, or ask to wait.
        What was perhaps received does no harm a second time: `fetch` gives a POST its key.
        """
        until_s = time.monotonic() + (self._reconnect_s if self._reached else 0.0)
        while True:
            if time.monotonic() - self._used_s > _IDLE_S:
                self._connection.close()  # the service may have closed it
            self._used_s, used = time.monotonic(), self._connection.sock is not None
            try:
                self._connection.request(method, path, body, headers)
                response = self._connection.getresponse()
                content = response.read()
            except (ConnectionError, IncompleteRead):  # `RemoteDisconnected` is one
                self._connection.close()
                if not used:
                    if time.monotonic() > until_s:
                        raise
                    time.sleep(PAUSE_S)
            else:
                self._reached = True
                wait = response.headers.get("Retry-After", "")
                if response.status != 503 or not wait.isdecimal():
                    return response, content
                if time.monotonic() + int(wait) > until_s:
                    return response, content
                time.sleep(int(wait))

    def stream_url(self, name: str, what: str) -> str:
        """The address of a WebSocket."""
        scheme = "wss" if self._url.scheme == "https" else "ws"
        return f"{scheme}://{self._url.netloc}/v1/sessions/{quote(name)}/{what}"

    def stream(self, name: str) -> StreamClient:
        """A WebSocket for the frames and states of a session."""
        about = dict(self._headers), self._tls, self._reconnect_s, self._timeout_s
        return StreamClient(self.stream_url(name, "stream"), *about)

    def close(self) -> None:
        """Close the connection; the sessions stay open."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SessionClient:
    """One session of a service."""

    def __init__(self, client: Client, name: str) -> None:
        self.client = client
        self.name = name
        self._path = f"/v1/sessions/{quote(name)}"

    def track(
        self, frame: Frame, time_s: float | None = None, roi: npt.ArrayLike | None = None
    ) -> StateDict:
        """Track a frame; its state. ``roi``: where in it the target is, as of `Client.open`.

        Raises:
            ServiceError: the frame is refused (422), or too many frames wait (429).
            RendezviewError: the service cannot be reached.
        """
        content, kind = frame_content(frame)
        query = frame_query(time_s, roi)
        state: StateDict = self.client.request("POST", f"{self._path}/frames{query}", content, kind)
        return state

    def measure(self, sensor: str, *records: Mapping[str, Any]) -> StateDict:
        """Send lines of another sensor's log to the filter; its answer.

        Raises:
            ServiceError: a line is wrong (422), or too many lines wait (429).
            RendezviewError: the service cannot be reached.
        """
        lines = "\n".join(map(json_line, records)).encode()
        path = f"{self._path}/measurements?sensor={quote(sensor, safe='')}"
        answer: StateDict = self.client.request("POST", path, lines, "application/x-ndjson")
        return answer

    def stream(self) -> StreamClient:
        """A WebSocket for frames and states, for high frame rates."""
        return self.client.stream(self.name)

    def state(self) -> StateDict:
        """The last state."""
        state: StateDict = self.client.request("GET", f"{self._path}/state")
        return state

    def info(self) -> dict[str, Any]:
        """The session's `SessionInfo`."""
        info: dict[str, Any] = self.client.request("GET", self._path)
        return info

    def history(self, seconds: float = 300.0, limit: int = 2000) -> list[StateDict]:
        """States of the last minutes."""
        path = f"{self._path}/history?seconds={seconds!r}&limit={limit}"
        states: list[StateDict] = self.client.request("GET", path)["states"]
        return states

    def log(self) -> bytes:
        """The log so far, as an MCAP file."""
        return self.client.fetch("GET", f"{self._path}/log")

    def close(self) -> None:
        """End the session and complete its log."""
        self.client.request("DELETE", self._path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the session; if another error is on its way, that one counts."""
        try:
            self.close()
        except RendezviewError:
            if kind is None:
                raise


def _tls(certificate: Path | str | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=certificate)
    except OSError as error:  # of ssl too
        raise RendezviewError(
            f"{certificate}: not a certificate (PEM) that can be read: {error}"
        ) from None
