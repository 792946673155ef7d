"""Shared code of all routes: errors as messages, rights, bodies of limited length."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import math
import re
import secrets
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import Depends, FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from pydantic import TypeAdapter
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.responses import Response, StreamingResponse

from rendezview.errors import RendezviewError
from rendezview.io.files import checked, write_error
from rendezview_service.http.security import fault
from rendezview_service.hub.inputs import Answer, NotReady, Refused, SessionInput
from rendezview_service.hub.model_store import NameTaken
from rendezview_service.hub.service import Service
from rendezview_service.hub.sessions import Session
from rendezview_service.logs.log_repair import LogPart, join
from rendezview_service.messages.frames import Bytes
from rendezview_service.messages.message_parts import (
    CAMERA,
    NAME_PATTERN,
    Fault,
    FrameHead,
)

FAULTS: dict[int | str, dict[str, Any]] = {
    code: {"model": Fault} for code in (400, 401, 403, 404, 409, 413, 422, 429, 503)
}
JSON, BYTES = "application/json", "application/octet-stream"
BINARY = {"schema": {"type": "string", "format": "binary"}}
SENDER_HEADER, KEY_HEADER = "X-Sender", "Idempotency-Key"
_FRAME_HEAD = TypeAdapter(FrameHead)
_LONGEST_KEY = 128  # characters. Source: a chosen limit
FoundT = TypeVar("FoundT")


def service_of(connection: HTTPConnection) -> Service:
    """The service behind the application."""
    service: Service = connection.app.state.service
    return service


def found(thing: FoundT | None, what: str, where: str) -> FoundT:
    """What a path names.

    Raises:
        HTTPException: 404, there is none; ``where`` has those that there are.
    """
    if thing is None:
        raise HTTPException(404, f"{what}: there is none: see {where}")
    return thing


def session_of(connection: HTTPConnection, name: str) -> Session:
    """A session by its id.

    Raises:
        HTTPException: 404.
        NotReady: it is one of an earlier run, which will go on.
    """
    service = service_of(connection)
    session = service.sessions.get(name)
    if session is None and name in service.resuming:
        raise NotReady(f"session {name} goes on in a moment: the service has started again")
    if session is None and name in service.ended:
        raise HTTPException(404, f"session {name} has ended: {service.ended[name]}")
    return found(session, f"session {name[:80]!r}", "/v1/sessions")


async def _opened(request: Request, name: str) -> Session:
    return session_of(request, name)


Opened = Annotated[Session, Depends(_opened)]  # the session in a route's path


def body_in_docs(content: dict[str, Any]) -> dict[str, Any]:
    """A route's body for the description of the API, by its media types."""
    return {"requestBody": {"required": True, "content": content}}


async def pieces_of(request: Request, most: int) -> list[Bytes]:
    """The body in the pieces that arrive, refused as soon as it is too long.

    The pieces are not joined, so that a frame is copied only once, to the worker; then they go.

    Raises:
        HTTPException: 413.
    """
    pieces: list[Bytes] = []
    length = 0
    declared = int(request.headers.get("content-length", "0"))
    if declared <= most:
        async for piece in request.stream():
            pieces.append(piece)
            if (length := length + len(piece)) > most:
                break
    if max(length, declared) > most:
        raise HTTPException(413, f"the body is too long: send at most {most} bytes")
    return pieces


@contextlib.asynccontextmanager
async def file_of(request: Request, folder: Path) -> AsyncIterator[Path]:
    """The body as a file in a folder; if it is still there at the end, it is removed.

    Raises:
        RendezviewError: the disk is full, or the folder is gone.
    """
    path = folder / f".{secrets.token_hex(6)}.tmp"
    try:
        try:
            with open(path, "xb") as file:
                async for piece in request.stream():
                    await run_in_threadpool(file.write, piece)
        except OSError as error:
            raise write_error(folder, error) from error
        yield path
    finally:
        path.unlink(missing_ok=True)


def answered(answer: Answer) -> Response:
    """A worker's answer, as that to the request."""
    if answer.status != 200:
        return fault(answer.status, answer.error, again=False)
    return Response(answer.body, 200, None, JSON)


async def download(name: str, parts: Sequence[LogPart]) -> Response:
    """The parts of a log, as one complete MCAP file."""
    joined = await run_in_threadpool(join, parts)
    headers = {
        "Content-Disposition": f'attachment; filename="{name}"',
        "Content-Length": str(joined.length),
    }
    return StreamingResponse(joined.blocks(), 200, headers, media_type=BYTES)


async def track(
    session: Session, pieces: list[Bytes], head: FrameHead, sender: str, key: str | None
) -> Answer:
    """The answer of the session's tracker to a frame.

    Raises:
        Refused: as `Session.queue`.
        RendezviewError: the key belongs to another request.
    """
    about = "frame", head.model_dump_json(), sum(map(len, pieces))
    given = partial(session.input, pieces, head.time_s, sender=sender, key=key, roi=head.roi)
    return await session.once.do(key, about, lambda: _answered(given, session.queue))


async def measure(session: Session, sensor: str, content: bytes, key: str | None) -> Answer:
    """The answer of the session's filter to lines of another sensor.

    Raises:
        Refused: as `Session.measure`.
        RendezviewError: the key belongs to another request.
    """
    given = partial(session.input, [content], None, sensor=sensor)
    return await session.once.do(key, (sensor, content), lambda: _answered(given, session.measure))


async def _answered(
    given: Callable[[Callable[[Answer], None]], SessionInput], put: Callable[[SessionInput], None]
) -> Answer:
    """The answer to an input that ``put`` gives to its session."""
    future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
    put(given(lambda result: None if future.done() else future.set_result(result)))
    return await future


def key_of(connection: HTTPConnection) -> str | None:
    """The key with which a request may be repeated.

    Raises:
        HTTPException: 422, it is too long.
    """
    key = connection.headers.get(KEY_HEADER)
    if key is not None and not 0 < len(key) <= _LONGEST_KEY:
        raise HTTPException(422, f"{KEY_HEADER}: use 1 to {_LONGEST_KEY} characters")
    return key


def sensor_name(name: object) -> str:
    """A sensor's name, checked; ``camera`` is reserved.

    Raises:
        HTTPException: 422.
    """
    if not isinstance(name, str) or not re.fullmatch(NAME_PATTERN, name):
        raise HTTPException(
            422, f"sensor: use at most 64 letters, digits, - and _, not {name!r:.80}"
        )
    if name == CAMERA:
        raise HTTPException(422, "sensor: camera is the session's own camera: choose another name")
    return name


def sender_of(connection: HTTPConnection) -> str:
    """Who sends frames: the header ``X-Sender``, or else the caller's machine."""
    named = connection.headers.get(SENDER_HEADER, "")
    if named:
        return f"named {hashlib.sha256(named.encode()).hexdigest()}"
    return f"at {connection.client.host}" if connection.client else "unknown"


def frame_head(given: dict[str, Any], where: str) -> FrameHead:
    """Time and region of a frame, checked.

    Raises:
        RendezviewError: NaN, infinity or beyond ±1e10 s, or a region that is none.
    """
    return checked(_FRAME_HEAD, given, where)


def fault_of(error: Exception) -> Response | None:
    """An error as a `Fault`; None for an error inside the service."""
    match error:
        case HTTPException():
            return fault(error.status_code, str(error.detail), dict(error.headers or {}))
        case RequestValidationError():
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            return fault(422, f"{where}: {first['msg']}")
        case RendezviewError():
            return fault(409 if isinstance(error, NameTaken) else 422, str(error))
        case Refused():
            again = {"Retry-After": f"{math.ceil(error.after_s)}"} if error.status != 409 else {}
            return fault(error.status, str(error), again)
        case ClientDisconnect():
            return fault(400, "the request was cut off")
    return None


def answer_errors(app: FastAPI) -> None:
    """Have the application answer every error with a `Fault`."""

    async def handler(_: Request, error: Exception) -> Response:
        answer = fault_of(error)
        assert answer is not None
        return answer

    known = HTTPException, RequestValidationError, RendezviewError, Refused, ClientDisconnect
    for kind in known:
        app.add_exception_handler(kind, handler)
