"""WebSockets: one takes frames and sends states, one sends states and pictures to watchers."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import struct
from collections import deque
from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Query, WebSocket
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocketDisconnect

from rendezview.errors import RendezviewError
from rendezview.io.files import parse_json
from rendezview_service.http.answers import (
    SENDER_HEADER,
    frame_head,
    sender_of,
    sensor_name,
    service_of,
    session_of,
)
from rendezview_service.http.budgets import KEEP
from rendezview_service.http.security import SUBPROTOCOL
from rendezview_service.hub.inputs import Answer, NotReady, Refused
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.watching import Watcher
from rendezview_service.messages.message_parts import Fault
from rendezview_service.messages.messages import WatchEnd
from rendezview_service.settings import Settings

router = APIRouter(prefix="/v1/sessions")

_TIME = struct.Struct("<d")
_HEAD = b'{"time_s"'  # of a frame's line of JSON: as a time, it is 1e247 s
MOST_HEAD = 1000  # bytes of this line. Source: a chosen limit
_OUTBOX = 64  # unread answers; with more, no frames are received. Source: a chosen limit
_REFUSED, _GONE, _SOON = 1008, 1001, 1013


@router.websocket("/{name}/stream")
async def stream(socket: WebSocket, name: str) -> None:
    """Receives frames and sensor lines, sends states.

    While a frame is tracked, the newest frame waits; older ones are dropped.
    """
    session = await _accepted(socket, name)
    if session is None:
        return
    sender_name = sender_of(socket) if SENDER_HEADER in socket.headers else f"stream {id(socket)}"
    outbox: deque[Answer] = deque()
    news, room = asyncio.Event(), asyncio.Event()
    room.set()

    def answer(result: Answer) -> None:
        if result.status == 0:  # dropped
            return
        outbox.append(result)
        if len(outbox) >= _OUTBOX:
            room.clear()
        news.set()

    async def send() -> None:
        while True:
            await news.wait()
            news.clear()
            while outbox:
                result = outbox.popleft()
                if result.status == 200:
                    await socket.send({"type": "websocket.send", "text": result.body.decode()})
                else:
                    text = Fault(error=result.error, status=result.status).model_dump_json()
                    await socket.send({"type": "websocket.send", "text": text})
                if result.ends:
                    final = _GONE if result.status == 410 else _SOON
                    await socket.close(final, result.error[:100])
                    return
            room.set()

    sender = asyncio.create_task(send())
    sender.add_done_callback(lambda _: room.set())  # who waits for room sees that it has ended
    try:
        with session.waiting.streaming(answer):
            while not sender.done():
                message = await socket.receive()
                if message["type"] != "websocket.receive":
                    break
                content = message.get("bytes")
                if content is None:
                    settings = service_of(socket).settings
                    _take_text(session, settings, message["text"], answer)
                else:
                    counted = _counted(socket, len(content), answer)
                    _take(session, content, counted, sender_name)
                await room.wait()
    except (WebSocketDisconnect, RuntimeError):
        pass
    finally:
        session.lease.release(sender_name)
        sender.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
            await sender


Answering = Callable[[Answer], None]


def _counted(socket: WebSocket, count: int, answer: Answering) -> Answering:
    """The bytes of a frame count until it is answered. In a cluster its gateway counts them."""
    if KEEP not in socket.scope:
        return answer
    let_go = socket.scope[KEEP](count)

    def answered(result: Answer) -> None:
        let_go()
        answer(result)

    return answered


def _take(session: Session, content: bytes, answer: Answering, sender: str) -> None:
    """A frame: a picture behind its time, or behind a line of JSON with time and region."""
    try:
        if content.startswith(_HEAD):
            line, where = content[:MOST_HEAD].partition(b"\n")[0], "the line before the picture"
            head = frame_head(parse_json(line.decode(errors="replace"), where), where)
            start = len(line) + 1
        elif len(content) > _TIME.size:
            (sent_s,), start = _TIME.unpack_from(content), _TIME.size
            head = frame_head({"time_s": None if math.isnan(sent_s) else sent_s}, "the frame")
        else:
            raise RendezviewError(
                "a frame must be 8 bytes of time, or a line of JSON, and a picture"
            )
        picture = memoryview(content)[start:]  # copied once, to the worker
        if len(picture) > session.frame_bytes:
            most = session.frame_bytes
            raise HTTPException(413, f"the frame is too long: send at most {most} bytes")
        at_s, region = head.time_s, head.roi
        session.replace(session.input([picture], at_s, answer, sender=sender, roi=region))
    except (HTTPException, RendezviewError, Refused) as error:
        answer(_refusal(error))


def _refusal(error: HTTPException | RendezviewError | Refused) -> Answer:
    if isinstance(error, HTTPException):
        return Answer(error.status_code, b"", str(error.detail))
    return Answer(error.status if isinstance(error, Refused) else 422, b"", str(error))


def _take_text(session: Session, settings: Settings, text: str, answer: Answering) -> None:
    """A text message ``{"sensor": name, "record": {…}}``."""
    most = min(settings.measurement_bytes, settings.frame_bytes)
    too_long = HTTPException(413, f"the message is too long: send at most {most} bytes")
    try:
        if len(text) > most:
            raise too_long
        message = parse_json(text, "the message")
        if not isinstance(message, dict) or set(message) != {"sensor", "record"}:
            raise RendezviewError(
                'a text message must be {"sensor": name, "record": a line of its log}'
            )
        sensor = sensor_name(message["sensor"])
        content = json.dumps(message["record"]).encode()
        if len(content) > most:
            raise too_long
        session.measure(session.input([content], None, answer, sensor=sensor))
    except (HTTPException, RendezviewError, Refused) as error:
        answer(_refusal(error))


@router.websocket("/{name}/watch")
async def watch(
    socket: WebSocket,
    name: str,
    rate_hz: Annotated[float, Query(gt=0.0, le=120.0)] = 30.0,
    image: bool = True,
    width: Annotated[int, Query(ge=16, le=4096)] = 640,
    contour: bool = True,
    silhouette: bool = False,
) -> None:
    """Sends the newest state, at most ``rate_hz`` times a second, with contours and pictures."""
    session = await _accepted(socket, name)
    if session is None:
        return
    service = service_of(socket)
    if service.watchers >= service.settings.watchers:
        await socket.close(_REFUSED, "there are too many watchers already")
        return
    watcher = Watcher(rate_hz, width if image else 0, contour, silhouette)
    session.watchers.add(watcher)
    service.watchers += 1
    listener = asyncio.create_task(_until_gone(socket))
    shower = asyncio.create_task(_show(socket, watcher))
    try:
        await asyncio.wait({listener, shower}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        session.watchers.discard(watcher)
        service.watchers -= 1
        for task in (listener, shower):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await task


async def _show(socket: WebSocket, watcher: Watcher) -> None:
    async for text, picture in watcher.messages():
        await socket.send({"type": "websocket.send", "text": text.decode()})
        if picture:
            await socket.send({"type": "websocket.send", "bytes": picture})
    reason = watcher.ended or ""
    end = WatchEnd(reason=reason).model_dump_json()
    await socket.send({"type": "websocket.send", "text": end})
    await socket.close(_GONE, reason[:100])


async def _until_gone(socket: WebSocket) -> None:
    """Ignore messages of a watcher until it disconnects."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


async def _accepted(socket: WebSocket, name: str) -> Session | None:
    # Accept first: a browser gives its page no reason for a refused handshake.
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        return session_of(socket, name)
    except (HTTPException, NotReady) as error:
        code = _SOON if isinstance(error, NotReady) else _REFUSED
        await socket.close(code, _refusal(error).error[:100])
        return None
