"""A gateway: the service's address. It keeps nothing: any number may run, and each may end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import secrets
import time
from collections.abc import Callable
from typing import Any

import ray
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rendezview.errors import RendezviewError
from rendezview_service.cluster.orchestrator import NAMESPACE, join
from rendezview_service.cluster.tunnel import packed, unpacked
from rendezview_service.http.answers import KEY_HEADER, fault_of
from rendezview_service.http.app import page_files
from rendezview_service.http.security import Guard, Token, fault
from rendezview_service.hub.inputs import NotReady, Refused
from rendezview_service.hub.metrics import Metrics
from rendezview_service.messages.message_parts import BudgetUse
from rendezview_service.settings import Settings

log = logging.getLogger("rendezview_service")

_TRIES = 4  # slots that a request is sent to. Source: chosen
_GRACE_S = 2.0  # s, beyond `frame_timeout_s`, for a slot's answer. Source: chosen
_KNOW_S = 1.0  # s, between looks for new slots. Source: chosen
_PAUSE_S = 0.05  # s, before a session that moves is looked for again. Source: chosen
_CONNECT_S = 2.0  # s, for a first call to a slot. Source: chosen
_HEALTH_S = 5.0  # s, for the orchestrator's answer to a look at the health. Source: chosen
_NO_ORCHESTRATOR = (
    "the cluster's orchestrator does not answer: it starts again, or Ray's head node is gone. Open "
    "sessions go on; none is opened or moved"
)
_TRY_AGAIN = 1012  # WebSocket: the service restarts. Source: IANA's registry


class Gateway:
    """Passes requests on to the slot of their session, and to the orchestrator."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._settings, self._metrics = settings, metrics
        self._orchestrator: Any = None
        self._slots: dict[str, str] = {}  # of the sessions, as it knows
        self._actors: dict[str, Any] = {}  # of the slots
        self._page = page_files()
        self.budgets: dict[str, Callable[[], BudgetUse]] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] == "lifespan":
            await self._life(receive, send)
        elif scope["type"] == "websocket":
            await self._socket(scope, receive, send)
        elif scope["path"].startswith(("/v1/", "/healthz", "/readyz", "/openapi.json", "/docs")):
            response: Response | None
            try:
                response = await self._answer(scope, await Request(scope, receive).body())
            except ray.exceptions.RayActorError:
                response = fault(503, _NO_ORCHESTRATOR)
            except (Refused, RendezviewError, HTTPException, ClientDisconnect) as error:
                response = fault_of(error.cause if hasattr(error, "cause") else error)
            assert response is not None
            await response(scope, receive, send)
        elif scope["path"] == "/metrics":
            await self._health(True)
            text = Response(
                self._metrics.text(self._budgets()), 200, None, "text/plain; version=0.0.4"
            )
            await text(scope, receive, send)
        else:
            await self._page(scope, receive, send)

    def _budgets(self) -> dict[str, BudgetUse]:
        return {name: use() for name, use in self.budgets.items()}

    async def _life(self, receive: Receive, send: Send) -> None:
        await receive()
        self._orchestrator = await asyncio.to_thread(join, self._settings)
        await self._orchestrator.start.remote()
        knowing = asyncio.create_task(self._know_slots())
        await send({"type": "lifespan.startup.complete"})
        await receive()
        knowing.cancel()
        await asyncio.to_thread(ray.shutdown)
        await send({"type": "lifespan.shutdown.complete"})

    async def _know_slots(self) -> None:
        """Connect to all slots before they are needed: a first call to one takes a while."""
        while True:
            with contextlib.suppress(ray.exceptions.RayError, OSError, ValueError):
                found = await self._orchestrator.slots.remote()
                self._slots = {s["session"]: s["seat"] for s in found if s["session"] is not None}
                there = {known["seat"] for known in found}
                self._actors = {slot: a for slot, a in self._actors.items() if slot in there}
                for slot in there - set(self._actors):
                    with contextlib.suppress(ray.exceptions.RayError, OSError, ValueError):
                        await asyncio.wait_for(self._actor(slot).state.remote(), _CONNECT_S)
            await asyncio.sleep(_KNOW_S)

    async def _answer(self, scope: Scope, body: bytes) -> Response:
        path, method = scope["path"], scope["method"]
        parts = path.strip("/").split("/")
        if path in ("/healthz", "/readyz"):
            return await self._health(path == "/healthz")
        if parts[:2] == ["v1", "sessions"] and len(parts) == 2:
            if method == "POST":
                return await self._open(scope, body)
            if method == "GET":
                return await self._list(scope)
        if parts[:2] == ["v1", "sessions"] and len(parts) > 2:
            return await self._of_session(parts[2], packed(scope), body)
        if parts[:2] == ["v1", "models"] and parts[3:] == ["roll"] and method == "POST":
            return JSONResponse({"moved": await self._orchestrator.roll.remote(parts[2])})
        return unpacked(await self._orchestrator.http.remote(packed(scope), body))

    async def _health(self, of_itself: bool) -> Response:
        """The gateway lives without the orchestrator; it is ready with one that has slots."""
        slots: list[dict[str, Any]] = []
        reasons = []
        try:
            slots = await asyncio.wait_for(self._orchestrator.slots.remote(), _HEALTH_S)
        except NotReady as error:
            reasons.append(str(getattr(error, "cause", error)))
        except (ray.exceptions.RayError, TimeoutError):
            reasons.append(_NO_ORCHESTRATOR)
        if not slots and not reasons:
            reasons.append("no slot is ready: the cluster's nodes start")
        reasons += [reason for slot in slots for reason in slot["reasons"]]
        self._metrics.faults.set(len(reasons))
        status = ("degraded" if reasons else "ok") if slots else "not ready"
        used = {name: budget.model_dump() for name, budget in self._budgets().items()}
        health = {"status": status, "reasons": reasons, "seats": slots, "budgets": used}
        return JSONResponse(health, 200 if slots or of_itself else 503)

    async def _open(self, scope: Scope, body: bytes) -> Response:
        try:
            request = json.loads(body or b"{}")
        except ValueError:
            raise RendezviewError("the body is not JSON") from None
        key = Headers(scope=scope).get(KEY_HEADER)
        name, slot = await self._orchestrator.open.remote(request, key)
        self._slots[name] = slot
        answer = await self._info(scope, name)
        answer.status_code = 201 if answer.status_code == 200 else answer.status_code
        return answer

    async def _info(self, scope: Scope, name: str) -> Response:
        path = f"/v1/sessions/{name}"
        asked = packed(scope) | {"method": "GET", "path": path, "raw_path": path.encode()}
        return await self._of_session(name, asked, b"")

    async def _list(self, scope: Scope) -> Response:
        names = await self._orchestrator.sessions.remote()
        found = await asyncio.gather(*(self._info(scope, name) for name in names))
        sessions = [json.loads(bytes(one.body)) for one in found if one.status_code == 200]
        return JSONResponse({"sessions": sessions})

    async def _of_session(self, name: str, scope: dict[str, Any], body: bytes) -> Response:
        """A session's answer, from its next slot if its slot ends over the request."""
        limit_s = self._settings.frame_timeout_s + _GRACE_S
        dead = left = None
        for _ in range(_TRIES):
            asked_s = time.monotonic()
            slot = await self._slot(name, dead)
            if slot is None:
                return fault(404, f"session {name[:80]!r}: there is none with this id")
            if dead is not None:
                _note("another slot continues", name, asked_s)
            asked_s = time.monotonic()
            try:
                asked = self._actor(slot).http.remote(name, scope, body)
                return unpacked(await asyncio.wait_for(asked, limit_s))
            except (ray.exceptions.RayActorError, OSError, ValueError):
                dead = slot
                self._actors.pop(slot, None)
                _note("a slot has ended", name, asked_s)
            except LookupError:  # it has moved, or is closed, or its slot has started again
                dead = slot if slot == left else None
                left = slot
                self._slots.pop(name, None)
                await asyncio.sleep(_PAUSE_S)
        raise NotReady("the session moves: try again in a moment")

    def _actor(self, slot: str) -> Any:
        """The slot's actor.

        Raises:
            ValueError: there is none.
        """
        if slot not in self._actors:
            self._actors[slot] = ray.get_actor(slot, NAMESPACE)
        return self._actors[slot]

    async def _slot(self, name: str, dead: str | None) -> str | None:
        if dead is None and name in self._slots:
            return self._slots[name]
        slot: str | None = await self._orchestrator.where.remote(name, dead)
        if slot is None:
            self._slots.pop(name, None)
        else:
            self._slots[name] = slot
        return slot

    async def _socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a WebSocket on; if the slot ends it is closed, and clients open it again."""
        await receive()
        parts, key = scope["path"].strip("/").split("/"), secrets.token_hex(8)
        name = parts[2] if len(parts) > 2 else ""
        accepted, dead, left = False, None, None

        async def passed_on(message: Message) -> None:
            nonlocal accepted
            accepted = True
            await send(message)

        for _ in range(_TRIES):
            try:
                slot = await self._slot(name, dead)
            except (Refused, RendezviewError, ray.exceptions.RayError):
                break
            if slot is None:
                await send({"type": "websocket.close", "code": 1008, "reason": "no such session"})
                return
            try:
                await _relay(self._actor(slot), name, key, packed(scope), receive, passed_on)
            except LookupError:  # as for requests
                dead = slot if slot == left else None
                left = slot
            except (ray.exceptions.RayError, ValueError, OSError):
                dead = slot
                self._actors.pop(slot, None)
            else:
                return
            self._slots.pop(name, None)
            if accepted:
                break
            await asyncio.sleep(_PAUSE_S)
        with contextlib.suppress(RuntimeError):
            await send({"type": "websocket.close", "code": _TRY_AGAIN, "reason": "it moves"})


def _note(what: str, session: str, since_s: float) -> None:
    log.warning(what, extra={"session": session, "took_s": round(time.monotonic() - since_s, 3)})


async def _relay(
    actor: Any, name: str, key: str, scope: Scope, receive: Receive, send: Send
) -> None:
    """Pass the messages of a WebSocket on, both ways, until it ends."""
    pump = None
    stream = actor.socket.options(num_returns="streaming").remote(name, key, scope)
    try:
        async for reference in stream:
            message: Message = await reference
            await send(message)
            if pump is None:
                pump = asyncio.create_task(_pump(actor, key, receive))
    finally:
        if pump is not None:
            pump.cancel()


async def _pump(actor: Any, key: str, receive: Receive) -> None:
    with contextlib.suppress(ray.exceptions.RayError):
        while True:
            message = dict(await receive())
            if not await actor.give.remote(key, message):
                return
            if message["type"] == "websocket.disconnect":
                return


def make_gateway(settings: Settings, tokens: list[Token]) -> ASGIApp:
    """The application of a gateway."""
    metrics = Metrics()
    gateway = Gateway(settings, metrics)
    guard = Guard(gateway, settings, tokens, metrics)
    gateway.budgets |= guard.budgets
    return guard
