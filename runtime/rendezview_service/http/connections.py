"""Connections of a bounded number, with bounded heads, that may not wait or be unread for ever.

uvicorn has no limits for a request that is not complete yet; these come before any token.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable, Collection
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request

from rendezview_service.hub.clock import Timer
from rendezview_service.messages.message_parts import BudgetUse

HEAD_S = 10.0  # s, for the first line and the headers of a request. Source: chosen
ABORT = "rendezview.abort"  # key of a request's scope: closes its connection, for a reason
ARRIVES = "rendezview.arrives"  # key of a WebSocket's scope: takes who is told of its bytes
_READ_S = 10.0  # s, in which an answer that waits for its reader … Source: chosen
_LEAST_READ = 50_000  # … must become shorter by so many bytes. Source: chosen, a slow radio link
_MOST_UNREAD = 32_000_000  # bytes of all answers that wait for their readers. Source: chosen
_ROOM_S = 0.05  # s, that too many connections are borne, for their heads. Source: chosen
_CLOSE_S = 1.0  # s, for the other side's part of a WebSocket's end. Source: chosen
MOST_HEAD = 65_536  # bytes of them. Source: a chosen limit, four times that of most servers


class BoundedProtocol(HttpToolsProtocol):
    """A connection that is closed if its request's head is slow or long.

    With too many connections, those that have waited longest without a request are closed: first
    those that have sent none to its end. With too many bytes that nobody reads, the one that has
    the most.
    """

    most = 1000
    # Without a request in progress, and since when: that have sent none to its end, and others.
    _strangers: dict[BoundedProtocol, float]
    _known: dict[BoundedProtocol, float]
    _unread: set[BoundedProtocol]  # whose answers wait for their readers
    opened: Collection[Any] = ()  # all, of WebSockets too

    @classmethod
    def budgets(cls) -> dict[str, Callable[[], BudgetUse]]:
        """What is in use of its limits."""

        def unread() -> BudgetUse:
            return BudgetUse(used=sum(map(_unread_bytes, cls._unread)), most=_MOST_UNREAD)

        return {
            "connections": lambda: BudgetUse(used=len(cls.opened), most=cls.most),
            "unread_bytes": unread,
        }

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A connection; perhaps another one must make room."""
        self._head_bytes: int | None = 0  # None: no head is being received
        self._head_timer: Timer | None = None
        self._read_timer: Timer | None = None
        self._has_read = False
        super().connection_made(transport)
        type(self).opened = self.connections
        self._strangers[self] = self.loop.time()
        self._await_head()
        self._limit()

    def data_received(self, data: bytes) -> None:
        """Bytes of a request."""
        super().data_received(data)
        if self._head_bytes is not None:
            self._head_bytes += len(data)
            if self._head_bytes > MOST_HEAD:
                self.abort()

    def on_message_begin(self) -> None:
        """The first byte of a request."""
        super().on_message_begin()
        if self._head_bytes is None:
            self._await_head()

    def on_headers_complete(self) -> None:
        """The head is complete."""
        length = len(self.url) + sum(len(name) + len(value) for name, value in self.headers)
        if length > MOST_HEAD:
            raise ValueError("the head is too long")  # answered with 400
        self._stop_waiting()
        super().on_headers_complete()
        scope: dict[str, Any] = self.scope  # type: ignore[assignment]
        scope[ABORT] = lambda reason: self.abort()

    def pause_writing(self) -> None:
        """An answer waits for its reader."""
        super().pause_writing()
        self._unread.add(self)
        self._await_reader()
        while sum(map(_unread_bytes, self._unread)) > _MOST_UNREAD:
            max(self._unread, key=_unread_bytes).abort()

    def resume_writing(self) -> None:
        """It is read."""
        super().resume_writing()
        self._unread.discard(self)
        self._has_read = True

    def on_response_complete(self) -> None:
        """The answer is sent; the connection may be used again."""
        super().on_response_complete()
        if self.transport.is_closing():  # when the rest is read
            self._await_reader()
        idle = self._head_bytes is None and self.cycle.response_complete
        if idle and not self.transport.is_closing():
            waiting = self._strangers if self.cycle.more_body else self._known
            waiting[self] = self.loop.time()
            self._limit()

    def timeout_keep_alive_handler(self) -> None:
        """Without a request for long; perhaps the last answer is not read either."""
        if not self.transport.is_closing():
            self.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """The end of the connection."""
        self._stop_waiting()
        self._stop_reading()
        super().connection_lost(exc)

    def abort(self) -> None:
        """Close the connection without an answer; the system keeps nothing that is unread."""
        if _unread_bytes(self):
            connection = self.transport.get_extra_info("socket")
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connections.discard(self)
        self._stop_waiting()
        self._stop_reading()
        self.transport.abort()

    def _limit(self) -> None:
        """Close what is too much, after a moment for the heads that have come and are not read."""
        if len(self.connections) > self.most:
            self.loop.call_later(_ROOM_S, self._make_room, self.most, 0.5 * _ROOM_S)
        self._make_room(2 * self.most, 0.0)

    def _make_room(self, most: int, waited_s: float) -> None:
        """Close those that have waited for so long, as long as there are more than so many."""
        before_s = self.loop.time() - waited_s
        for waiting in (self._strangers, self._known):
            while len(self.connections) > most and waiting:
                oldest, since_s = next(iter(waiting.items()))
                if since_s > before_s:
                    break
                oldest.abort()

    def _await_head(self) -> None:
        self._head_bytes, self._head_timer = 0, Timer(HEAD_S, self.abort)

    def _await_reader(self) -> None:
        """See that somebody reads, as long as something is unread."""
        if self._read_timer is not None:
            return
        self._has_read, before = False, _unread_bytes(self)

        def check() -> None:
            self._read_timer, left = None, _unread_bytes(self)
            if left and not self._has_read and before - left < _LEAST_READ:
                self.abort()
            elif left:
                self._await_reader()

        self._read_timer = Timer(_READ_S, check)

    def _stop_reading(self) -> None:
        self._unread.discard(self)
        if self._read_timer is not None:
            self._read_timer.cancel()
            self._read_timer = None

    def _stop_waiting(self) -> None:
        self._head_bytes = None
        self._strangers.pop(self, None)
        self._known.pop(self, None)
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None


def _unread_bytes(connection: BoundedProtocol) -> int:
    size: int = connection.transport.get_write_buffer_size()
    return size


class BoundedSocket(WebSocketsSansIOProtocol):
    """A WebSocket that is gone soon after its end, whatever the other side does."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A connection that was one for requests."""
        super().connection_made(transport)
        self.close_timeout = _CLOSE_S
        self._incoming = 0  # bytes that came for no complete message yet
        self._arrives: Callable[[int], bool] = lambda count: True

    def handle_connect(self, event: Request) -> None:
        """The handshake."""
        super().handle_connect(event)
        if self.handshake_initiated and not self.close_sent:
            scope: dict[str, Any] = self.scope  # type: ignore[assignment]
            scope[ARRIVES] = self._report_to

    def _report_to(self, arrives: Callable[[int], bool]) -> Callable[[], None]:
        """Ask whether bytes may arrive; the function that it returns refuses all from then on."""
        self._arrives, self._incoming = arrives, 0  # the handshake is no part of a message
        return self._refuse_all

    def connection_lost(self, exc: Exception | None) -> None:
        """The end of the connection, and of what has come of a message."""
        super().connection_lost(exc)
        self._refuse_all()

    def _refuse_all(self) -> None:
        self._arrives = lambda count: False
        self.conn.reader.discard()
        self.frames.clear()

    def data_received(self, data: bytes) -> None:
        """Bytes of messages, counted until the application takes these."""
        self._incoming += len(data)
        if self._arrives(len(data)):
            super().data_received(data)
        else:  # its end follows
            self.transport.pause_reading()

    def send_receive_event_to_app(self) -> None:
        """A message is complete; what is not parsed yet belongs to the next one."""
        length, left = sum(map(len, self.frames)), len(self.conn.reader.buffer)
        self._arrives(left + length - self._incoming)
        self._incoming = left
        super().send_receive_event_to_app()

    def send_keepalive_ping(self) -> None:
        """Ask whether the other side is there; a pause of the service is not its silence."""
        super().send_keepalive_ping()
        if self.pong_timer is not None and self.ping_timeout is not None:
            self.pong_timer.cancel()
            self.pong_timer = Timer(self.ping_timeout, self.keepalive_timeout)  # type: ignore[assignment]


def bounded(most: int) -> type[BoundedProtocol]:
    """The protocol with its number of connections and its own record of them."""
    members: dict[str, Any] = {"most": most, "_strangers": {}, "_known": {}, "_unread": set()}
    return type("Bounded", (BoundedProtocol,), members)
