"""ASGI over calls: a gateway passes requests and WebSockets on to an application elsewhere."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Scope

# What a scope needs on the other side; all of it can be pickled.
_KEYS = (
    "type", "asgi", "http_version", "method", "scheme", "path", "raw_path", "query_string",
    "root_path", "headers", "client", "server", "subprotocols", "state",
)  # fmt: skip
_MOST_WAITING = 8  # messages of a WebSocket that are not read yet. Source: chosen


def packed(scope: Scope) -> dict[str, Any]:
    """The scope of a request as plain data."""
    return {name: scope[name] for name in _KEYS if name in scope}


def unpacked(answer: tuple[int, list[Any], bytes]) -> Response:
    """The answer that `exchange` gave on the other side."""
    status, headers, body = answer
    response = Response(body, status)
    response.raw_headers = headers
    return response


async def exchange(app: ASGIApp, scope: Scope, body: bytes) -> tuple[int, list[Any], bytes]:
    """The application's answer to a request: status, headers, body."""
    asked = False
    start: Message = {}
    parts: list[bytes] = []

    async def receive() -> Message:
        nonlocal asked
        if asked:
            await asyncio.Event().wait()  # the caller stays until the answer is complete
        asked = True
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Message) -> None:
        if message["type"] == "http.response.start":
            start.update(message)
        else:
            parts.append(message.get("body", b""))

    await app(scope, receive, send)
    return start["status"], list(start["headers"]), b"".join(parts)


class Sockets:
    """WebSockets whose other end is at a gateway."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._waiting: dict[str, asyncio.Queue[Message]] = {}

    async def messages(self, key: str, scope: Scope) -> AsyncIterator[Message]:
        """What the application sends, until it ends or `end` is called."""
        inbox = self._waiting[key] = asyncio.Queue(_MOST_WAITING)
        outbox: asyncio.Queue[Message | None] = asyncio.Queue(_MOST_WAITING)
        inbox.put_nowait({"type": "websocket.connect"})

        async def run() -> None:
            try:
                await self._app(scope, inbox.get, outbox.put)
            finally:
                await outbox.put(None)

        task = asyncio.create_task(run())
        try:
            while (message := await outbox.get()) is not None:
                yield message
        finally:
            task.cancel()
            self._waiting.pop(key, None)
            for queue in (inbox, outbox):  # who waits for room there need not any more
                while not queue.empty():
                    queue.get_nowait()

    async def give(self, key: str, message: Message) -> bool:
        """A message for the application; False if it has ended."""
        inbox = self._waiting.get(key)
        if inbox is None:
            return False
        await inbox.put(message)
        return True
