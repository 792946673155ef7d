"""Budgets of requests and WebSockets: a client that exceeds one pays for it, not its neighbours.

Each has a time by which it must have moved on: a body or an answer at a least rate, a WebSocket by
its next message. Over budget, the client with the most loses the one that is nearest to that time.
Whoever moves on is far from it, so that many slow ones push each other out.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

from rendezview_service.hub.clock import Timer
from rendezview_service.settings import Settings

_PATIENCE_S = 10.0  # s, without moving on … Source: chosen
_SLOWEST = 50_000.0  # … and a second more for so many bytes. Source: chosen, a slow radio link
_MUCH = 16_000_000  # bytes; what bodies of more have held is given back. Source: chosen
_TRY_AGAIN = 1013  # WebSocket: try again later. Source: IANA's registry


class Share:
    """A request or a WebSocket in progress: what it has of the budgets."""

    def __init__(self, caller: str) -> None:
        self.caller = caller
        self.held = 0  # bytes of its body
        self.due_s = time.monotonic() + _PATIENCE_S
        # Ends it for a reason; None: it is the service's turn, and nobody ends it for that.
        self.end: Callable[[str], None] | None = None

    def moved(self, count: float) -> None:
        """So many bytes have come or gone."""
        self.due_s = min(self.due_s + count / _SLOWEST, time.monotonic() + _PATIENCE_S)

    def moved_on(self) -> None:
        """A message has come or gone."""
        self.due_s = time.monotonic() + _PATIENCE_S


class Budget:
    """At most so many at once."""

    def __init__(self, most: int, what: str) -> None:
        """``what`` names them, for who is refused."""
        self._most, self._what = most, what
        self._shares: set[Share] = set()

    def enter(self, share: Share) -> None:
        """One more.

        Raises:
            HTTPException: 503, there are too many, and it is the service's turn in all of them.
        """
        reason = f"too many {self._what} at once: try again in a moment"
        if len(self._shares) >= self._most:
            slow = self._slowest()
            if slow is None or slow.end is None:
                raise HTTPException(503, reason)
            self.leave(slow)
            slow.end(f"{reason}, and send and read faster")
        self._shares.add(share)

    def leave(self, share: Share) -> None:
        """It is over; perhaps it was pushed out before."""
        self._shares.discard(share)

    def _slowest(self) -> Share | None:
        """Of the client with the most, if any of its can be ended."""
        count = Counter(share.caller for share in self._shares)
        most = max(count.values(), default=0)
        heavy = [s for s in self._shares if s.end is not None and count[s.caller] == most]
        return min(heavy, key=lambda share: share.due_s, default=None)


class Bodies:
    """The bodies of requests: each of limited length, all of them together too."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._held = self._peak = 0  # bytes
        self._open: set[Share] = set()

    def most(self, scope: Scope) -> int:
        """The longest body of a request, bytes."""
        path, settings = scope["path"], self._settings
        most = settings.message_bytes
        if path.endswith("/frames"):
            most = settings.frame_bytes
        elif path.endswith("/measurements"):
            most = min(settings.measurement_bytes, settings.frame_bytes)
        elif scope["method"] == "PUT" and path.startswith("/v1/models/"):
            most = settings.model_bytes
        elif path == "/v1/jobs":
            most = settings.mesh_bytes
        return min(most, settings.bodies_bytes)

    def received(self, scope: Scope, receive: Receive, share: Share) -> Body:
        """The body of a request."""
        self._open.add(share)
        return Body(self, receive, self.most(scope), share)

    def hold(self, share: Share, count: int) -> None:
        """Count bytes that arrive.

        Raises:
            HTTPException: 503, there are too many of all requests, and this one has the most.
        """
        reason = "the service receives too much at the moment: try again"
        share.held += count
        self._held += count
        self._peak = max(self._peak, self._held)
        while self._held > self._settings.bodies_bytes:
            arriving = (one for one in self._open if one.end is not None)
            largest = max(arriving, key=lambda one: one.held, default=None)
            if largest is None or largest.end is None or largest.held <= share.held:
                raise HTTPException(503, reason)
            self.drop(largest)
            largest.end(reason)

    def drop(self, share: Share) -> None:
        """A body is not needed any more."""
        self._open.discard(share)
        self._held -= share.held
        share.held = 0
        if self._held == 0 and self._peak > _MUCH:
            self._peak = 0
            trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # absent without glibc
            if trim is not None:
                asyncio.get_running_loop().call_later(0.1, trim, 0)


class Body:
    """One body, as an ASGI channel."""

    def __init__(self, bodies: Bodies, receive: Receive, most: int, share: Share) -> None:
        self._bodies, self._receive, self._most, self._share = bodies, receive, most, share
        self._length = 0
        self._refusal: str | None = None
        self.complete = False

    async def __call__(self) -> Any:
        """The next ASGI message.

        Raises:
            HTTPException: 408, 413 or 503.
        """
        if self.complete:
            return await self._receive()
        message = None if self._refusal else await self._next(self._receive)
        if self._refusal is not None:
            raise HTTPException(503, self._refusal)
        if message is None:
            raise HTTPException(408, "the body arrives too slowly: send it again")
        self.complete = not message.get("more_body", False)
        count = len(message.get("body", b""))
        if self._length + count > self._most:
            raise HTTPException(413, f"the body is too long: send at most {self._most} bytes")
        self._length += count
        self._share.moved(count)
        self._bodies.hold(self._share, count)
        return message

    def close(self) -> None:
        """The request is answered."""
        self._bodies.drop(self._share)

    async def _next(self, receive: Receive) -> Any:
        """The next message; None: it is late, or not wanted any more."""
        left_s = max(0.0, self._share.due_s - time.monotonic())
        try:
            async with asyncio.timeout(None) as waiting:

                def end(reason: str | None = None) -> None:
                    self._refusal = reason
                    waiting.reschedule(asyncio.get_running_loop().time())

                timer = Timer(left_s, end)
                self._share.end = end
                try:
                    return await receive()
                finally:
                    self._share.end = None
                    timer.cancel()
        except TimeoutError:
            return None


def watched(share: Share, receive: Receive, send: Send) -> tuple[Receive, Send]:
    """The channels of a WebSocket that a budget may end."""
    ended = asyncio.Event()
    closing: list[asyncio.Task[None]] = []

    async def close(reason: str) -> None:
        ended.set()
        with contextlib.suppress(RuntimeError, OSError):  # it has closed meanwhile
            await send({"type": "websocket.close", "code": _TRY_AGAIN, "reason": reason[:100]})

    def end(reason: str) -> None:
        closing.append(asyncio.create_task(close(reason)))

    async def received() -> Any:
        message = await receive()
        share.moved_on()
        if message["type"] == "websocket.connect":
            share.end = end
        return message

    async def sent(message: Any) -> None:
        if ended.is_set():  # the application does not know yet
            return
        await send(message)
        share.moved_on()

    return received, sent
