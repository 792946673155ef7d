"""Bodies of requests: of limited length, all of them together too, and not for ever."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope

from rendezview_service.settings import Settings

_BODY_S = 10.0  # s, for a body … Source: chosen
_SLOWEST = 50_000.0  # … and a second more for so many bytes. Source: chosen, a slow radio link


class Bodies:
    """The bodies that are being received."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._held = 0  # bytes

    def most(self, scope: Scope) -> int:
        """The longest body of a request, bytes."""
        path, settings = scope["path"], self._settings
        if path.endswith("/frames"):
            return settings.frame_bytes
        if path.endswith("/measurements"):
            return min(settings.measurement_bytes, settings.frame_bytes)
        if scope["method"] == "PUT" and path.startswith("/v1/models/"):
            return settings.model_bytes
        if path == "/v1/jobs":
            return settings.mesh_bytes
        return settings.message_bytes

    def received(self, scope: Scope, receive: Receive) -> Body:
        """The body of a request."""
        return Body(self, receive, self.most(scope))

    def hold(self, count: int) -> None:
        """Count bytes that arrive.

        Raises:
            HTTPException: 503, there are too many of all requests.
        """
        if self._held + count > self._settings.bodies_bytes:
            raise HTTPException(503, "the service receives too much at the moment: try again")
        self._held += count

    def drop(self, count: int) -> None:
        """Count bytes that are not needed any more."""
        self._held -= count


class Body:
    """One body, as an ASGI channel."""

    def __init__(self, bodies: Bodies, receive: Receive, most: int) -> None:
        self._bodies, self._receive, self._most = bodies, receive, most
        self._length = 0
        self._complete = False
        self._start_s = time.monotonic()

    async def __call__(self) -> Any:
        """The next ASGI message.

        Raises:
            HTTPException: 408, 413 or 503.
        """
        if self._complete:
            return await self._receive()
        due_s = self._start_s + _BODY_S + self._length / _SLOWEST
        try:
            async with asyncio.timeout(max(0.0, due_s - time.monotonic())):
                message = await self._receive()
        except TimeoutError:
            raise HTTPException(408, "the body arrives too slowly: send it again") from None
        self._complete = not message.get("more_body", False)
        count = len(message.get("body", b""))
        if self._length + count > self._most:
            raise HTTPException(413, f"the body is too long: send at most {self._most} bytes")
        self._bodies.hold(count)
        self._length += count
        return message

    def close(self) -> None:
        """The request is answered."""
        self._bodies.drop(self._length)
        self._length = 0
