"""A WebSocket for frames and states."""

from __future__ import annotations

import json
import ssl
import struct
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, optional
from rendezview.io.results import json_line
from rendezview_service.client.messages import (
    Frame,
    ServiceError,
    ServiceTimeout,
    StateDict,
    frame_content,
)

PAUSE_S = 0.2  # s, between attempts to connect. Source: chosen
_FINAL = (1001, 1008)  # the session has ended; refused. Source: RFC 6455, 7.4.1


class StreamClient:
    """Sends frames and receives states, independently of each other.

    A connection that breaks off is opened again; frames in flight are lost. One thread may send
    while another receives.
    """

    def __init__(
        self,
        url: str,
        headers: dict[str, str],
        tls: ssl.SSLContext | None = None,
        reconnect_s: float = 10.0,
        timeout_s: float = 30.0,
    ) -> None:
        """Open the stream.

        Args:
            reconnect_s: for how long a connection that broke off is opened again.
            timeout_s: of each attempt to open it.

        Raises:
            RendezviewError: it does not open.
        """
        self._url, self._headers, self._tls = url, headers, tls
        self._reconnect_s, self._timeout_s = reconnect_s, timeout_s
        self._lock = threading.Lock()
        self._closed = False
        self._socket = self._open()

    def _open(self) -> Any:
        with optional("streams need", "service", ", which is not installed"):
            from websockets.sync.client import connect
        try:
            opening = connect(
                self._url,
                additional_headers=self._headers,
                compression=None,
                max_size=None,
                ssl=self._tls,
                open_timeout=self._timeout_s,
            )
            return opening.__enter__()  # left by `close`
        except Exception as error:
            raise RendezviewError(f"{self._url}: the stream does not open ({error})") from None

    def send(
        self, frame: Frame, time_s: float | None = None, roi: npt.ArrayLike | None = None
    ) -> None:
        """Send a frame; it is dropped if a newer one arrives before it is tracked.

        Args:
            roi: where in it the target is, as of `Client.open`.

        Raises:
            RendezviewError: the stream has ended.
        """
        content, _ = frame_content(frame)
        head = struct.pack("<d", float("nan") if time_s is None else time_s)
        if roi is not None:  # in one message, which a new connection cannot tear apart
            region = np.asarray(roi, dtype=np.float64).tolist()
            head = f"{json_line({'time_s': time_s, 'roi': region})}\n".encode()
        self._send(b"".join((head, content)))

    def _send(self, message: bytes | str) -> None:
        from websockets.exceptions import ConnectionClosed

        while True:
            socket = self._socket
            try:
                return socket.send(message)  # type: ignore[no-any-return]
            except (ConnectionClosed, OSError) as error:
                self._again(socket, error)

    def measure(self, sensor: str, record: Mapping[str, Any]) -> None:
        """Send a line of another sensor's log; its answer has the type ``measured``."""
        self._send(json_line({"sensor": sensor, "record": record}))

    def receive(self, timeout_s: float | None = None) -> StateDict:
        """The next state, or the next answer to a sensor line.

        Raises:
            ServiceError: a frame or a line was refused.
            ServiceTimeout: none arrives in time.
            RendezviewError: the stream has ended.
        """
        from websockets.exceptions import ConnectionClosed

        while True:
            socket = self._socket
            try:
                answer: StateDict = json.loads(socket.recv(timeout_s))
                break
            except TimeoutError:
                raise ServiceTimeout(f"no state within {timeout_s:g} s") from None
            except (ConnectionClosed, OSError) as error:
                self._again(socket, error)
            except ValueError:
                raise RendezviewError("the answer is not JSON: is this the service?") from None
        if "error" in answer:
            raise ServiceError(answer["error"], answer["status"])
        return answer

    def _again(self, broken: Any, error: Exception) -> None:
        """Open the stream again, unless another thread has.

        Raises:
            RendezviewError: it has ended, or does not open in time.
        """
        received = getattr(error, "rcvd", None)
        until_s = time.monotonic() + self._reconnect_s
        with self._lock:
            while self._socket is broken:
                if self._closed or (received is not None and received.code in _FINAL):
                    raise RendezviewError(f"the stream has ended ({error})") from None
                try:
                    self._socket = self._open()
                except RendezviewError:
                    if time.monotonic() > until_s:
                        raise RendezviewError(f"the stream has ended ({error})") from None
                    time.sleep(PAUSE_S)

    def __iter__(self) -> Iterator[StateDict]:
        """States until the stream ends."""
        while True:
            try:
                yield self.receive()
            except ServiceError:
                raise
            except RendezviewError:
                return

    def close(self) -> None:
        """End the stream; the session stays open."""
        self._closed = True
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
