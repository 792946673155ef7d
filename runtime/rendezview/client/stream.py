"""A WebSocket for frames and states."""

from __future__ import annotations

import json
import ssl
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Self

from rendezview.client.messages import Frame, ServiceError, StateDict, frame_content
from rendezview.errors import RendezviewError
from rendezview.io.results import json_line


class StreamClient:
    """Sends frames and receives states, independently of each other."""

    def __init__(
        self, url: str, headers: dict[str, str], tls: ssl.SSLContext | None = None
    ) -> None:
        try:
            from websockets.sync.client import connect
        except ModuleNotFoundError:
            raise RendezviewError(
                "streams need websockets, which is not installed: pip install 'rendezview[service]'"
            ) from None
        try:
            opening = connect(
                url, additional_headers=headers, compression=None, max_size=None, ssl=tls
            )
            self._socket = opening.__enter__()  # left by `close`
        except Exception as error:
            raise RendezviewError(f"{url}: the stream does not open ({error})") from None

    def send(self, frame: Frame, time_s: float | None = None) -> None:
        """Send a frame; it is dropped if a newer one arrives before it is tracked.

        Raises:
            RendezviewError: the stream has ended.
        """
        content, _ = frame_content(frame)
        head = struct.pack("<d", float("nan") if time_s is None else time_s)
        self._send(b"".join((head, content)))

    def _send(self, message: bytes | str) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            self._socket.send(message)
        except ConnectionClosed as error:
            raise RendezviewError(f"the stream has ended ({error})") from None

    def measure(self, sensor: str, record: Mapping[str, Any]) -> None:
        """Send a line of another sensor's log; its answer has the type ``measured``."""
        self._send(json_line({"sensor": sensor, "record": record}))

    def receive(self, timeout_s: float | None = None) -> StateDict:
        """The next state, or the next answer to a sensor line.

        Raises:
            ServiceError: a frame or a line was refused.
            TimeoutError: none arrives in time.
            RendezviewError: the stream has ended.
        """
        from websockets.exceptions import ConnectionClosed

        try:
            answer: StateDict = json.loads(self._socket.recv(timeout_s))
        except ConnectionClosed as error:
            raise RendezviewError(f"the stream has ended ({error})") from None
        if "error" in answer:
            raise ServiceError(answer["error"], answer["status"])
        return answer

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
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
