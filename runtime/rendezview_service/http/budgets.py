"""Budgets of requests and WebSockets: a client that exceeds one pays for it, not its neighbours.

Each has a time by which it must have moved on: a body or an answer at a least rate, a WebSocket by
its next message. Over budget, the client with the most loses the one that is nearest to that time.
Whoever moves on is far from it, so that many slow ones push each other out. Of bytes, the one that
has the most is refused.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import math
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

from rendezview_service.http.connections import ARRIVES
from rendezview_service.hub.clock import Timer
from rendezview_service.messages.message_parts import BudgetUse

_PATIENCE_S = 10.0  # s, without moving on … Source: chosen
_SLOWEST = 50_000.0  # … and a second more for so many bytes. Source: chosen, a slow radio link
_TOLD_S = 10.0  # s, for which health says that somebody was refused. Source: chosen
# Bytes; a buffer of more grows without a copy, and goes back to the system when it is not needed.
# glibc otherwise keeps what it once gave back on its heap. Source: glibc's own first value
_MUCH = 131_072
_MMAP_THRESHOLD = -3  # of glibc's mallopt. Source: its malloc.h
KEEP = "rendezview.keep"  # key of a WebSocket's scope: see `Socket.keep`
_TRY_AGAIN = 1013  # WebSocket: try again later. Source: IANA's registry


class Share:
    """A request or a WebSocket in progress: what it has of the budgets."""

    def __init__(self, caller: str) -> None:
        self.caller = caller
        self.held = 0  # bytes that it has sent, as long as they are needed
        self.due_s = time.monotonic() + _PATIENCE_S
        # Ends it for a reason; None: it is the service's turn, and nobody ends it for that.
        self.end: Callable[[str], None] | None = None

    def moved(self, count: float) -> None:
        """So many bytes have come or gone."""
        self.due_s = min(self.due_s + count / _SLOWEST, time.monotonic() + _PATIENCE_S)

    def moved_on(self) -> None:
        """A message has come or gone."""
        self.due_s = time.monotonic() + _PATIENCE_S


class Limit:
    """What there is of something for all."""

    def __init__(self, most: int) -> None:
        self.most, self.held = most, 0
        self._exceeded_s = -math.inf

    def exceed(self) -> None:
        """Somebody is refused."""
        self._exceeded_s = time.monotonic()

    def use(self) -> BudgetUse:
        """How much of it is in use."""
        exceeded = time.monotonic() - self._exceeded_s < _TOLD_S
        return BudgetUse(used=self.held, most=self.most, exceeded=exceeded)


class Budget(Limit):
    """At most so many at once."""

    def __init__(self, most: int, what: str) -> None:
        """``what`` names them, for who is refused."""
        super().__init__(most)
        self._what = what
        self._shares: set[Share] = set()

    def enter(self, share: Share) -> None:
        """One more.

        Raises:
            HTTPException: 503, there are too many, and it is the service's turn in all of them.
        """
        reason = f"too many {self._what} at once: try again in a moment"
        if self.held >= self.most:
            self.exceed()
            slow = self._slowest()
            if slow is None or slow.end is None:
                raise HTTPException(503, reason)
            self.leave(slow)
            slow.end(f"{reason}, and send and read faster")
        self._shares.add(share)
        self.held = len(self._shares)

    def leave(self, share: Share) -> None:
        """It is over; perhaps it was pushed out before."""
        self._shares.discard(share)
        self.held = len(self._shares)

    def _slowest(self) -> Share | None:
        """Of the client with the most, if any of its can be ended."""
        count = Counter(share.caller for share in self._shares)
        most = max(count.values(), default=0)
        heavy = [s for s in self._shares if s.end is not None and count[s.caller] == most]
        return min(heavy, key=lambda share: share.due_s, default=None)


class Bodies(Limit):
    """The bytes that all who send have in memory, or on disk: bodies and messages."""

    def __init__(self, most: int) -> None:
        """``most``: bytes of all together."""
        super().__init__(most)
        allocate = getattr(ctypes.CDLL(None), "mallopt", None)  # absent without glibc
        if allocate is not None:
            allocate(_MMAP_THRESHOLD, _MUCH)
        self._open: set[Share] = set()

    def enter(self, share: Share) -> None:
        """It begins to send."""
        self._open.add(share)

    def hold(self, share: Share, count: int) -> None:
        """Count bytes that arrive; fewer than 0 are not needed any more.

        Raises:
            HTTPException: 503, there are too many, and this one has the most.
        """
        if share not in self._open:
            return
        share.held += count
        self.held += count
        while count > 0 and self.held > self.most:
            self.exceed()
            reason = "the service receives too much at the moment: try again"
            arriving = (one for one in self._open if one.end is not None)
            largest = max(arriving, key=lambda one: one.held, default=None)
            if largest is None or largest.end is None or largest.held <= share.held:
                raise HTTPException(503, reason)
            self.leave(largest)
            largest.end(reason)

    def leave(self, share: Share) -> None:
        """Nothing of it is needed any more; perhaps it was pushed out before."""
        self._open.discard(share)
        self.held -= share.held
        share.held = 0


class Body:
    """One body, as an ASGI channel."""

    def __init__(self, bodies: Bodies, receive: Receive, most: int, share: Share) -> None:
        """``most``: its longest length, bytes."""
        self._bodies, self._receive, self._share = bodies, receive, share
        self._most = min(most, bodies.most)
        bodies.enter(share)
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
        self._bodies.leave(self._share)

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


class Socket:
    """The channels of a WebSocket that a budget may end."""

    def __init__(
        self, bodies: Bodies, scope: Scope, receive: Receive, send: Send, share: Share
    ) -> None:
        self._bodies, self._receive, self._send, self._share = bodies, receive, send, share
        self._ended = asyncio.Event()
        self._closing: list[asyncio.Task[None]] = []
        bodies.enter(share)
        self._let_go: Callable[[], None] = lambda: None  # of what has come
        if ARRIVES in scope:
            self._let_go = scope[ARRIVES](self._arrives)
        scope[KEEP] = self.keep

    def keep(self, count: int) -> Callable[[], None]:
        """Count bytes of a message that was taken, until the function that it returns is called."""
        self._arrives(count)
        return partial(self._bodies.hold, self._share, -count)

    async def receive(self) -> Any:
        """The next ASGI message."""
        message = await self._receive()
        self._share.moved_on()
        if message["type"] == "websocket.connect":
            self._share.end = self._end
        self._bodies.hold(self._share, -len(message.get("bytes") or message.get("text") or b""))
        return message

    async def send(self, message: Any) -> None:
        """Send an ASGI message, unless it has ended and the application does not know yet."""
        if not self._ended.is_set():
            await self._send(message)
            self._share.moved_on()

    def close(self) -> None:
        """It is over."""
        self._bodies.leave(self._share)

    def _arrives(self, count: int) -> bool:
        """Bytes arrive, or fewer than 0 turn out to be none of a message; whether they may."""
        try:
            self._bodies.hold(self._share, count)
        except HTTPException as full:
            self._end(str(full.detail))
            return False
        return True

    def _end(self, reason: str) -> None:
        self._let_go()
        if not self._closing:
            self._closing.append(asyncio.create_task(self._close(reason)))

    async def _close(self, reason: str) -> None:
        self._ended.set()
        with contextlib.suppress(RuntimeError, OSError):  # it has closed meanwhile
            close = {"type": "websocket.close", "code": _TRY_AGAIN, "reason": reason[:100]}
            await self._send(close)
