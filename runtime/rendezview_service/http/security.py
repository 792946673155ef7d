"""The guard in front of the service: tokens with scopes, host names, request rates, headers."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import re
import socket
import time
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import SplitResult, urlsplit

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from rendezview.errors import RendezviewError
from rendezview.io.files import checked, read_toml
from rendezview_service.http.budgets import Bodies, Body, Budget, Share, Socket
from rendezview_service.http.connections import ABORT
from rendezview_service.hub.inputs import TokenBucket
from rendezview_service.hub.metrics import Metrics
from rendezview_service.messages.message_parts import Fault
from rendezview_service.settings import LOOPBACK, Settings

log = logging.getLogger("rendezview_service")

SUBPROTOCOL, TOKEN_SUBPROTOCOL = "rendezview", "token."
_FITS_SOCKET = re.compile(r"[\w!#$%&'*+\-.^`|~]+", re.ASCII)  # RFC 9110, 5.6.2
_ALWAYS = ("/healthz", "/readyz", "/metrics")  # are answered however much there is to do
_MOST_DOWNLOADS = 8  # each has the index of a log in memory: 15 MB an hour. Source: chosen
_MOST_CALLERS = 10_000  # whose request rates are remembered. Source: a chosen limit
_PAGE_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self'; worker-src 'self' blob:; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'; object-src 'none'"
)
HEADERS = (
    (b"content-security-policy", _PAGE_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"DENY"),
    (b"cross-origin-resource-policy", b"same-origin"),
)


class Right(IntEnum):
    """The rights of a token; each includes those before it."""

    NONE = 0
    READ = 1  # read states, pictures and logs
    TRACK = 2  # open sessions, send frames
    ADMIN = 3  # models and training


class _TokenEntry(BaseModel):
    model_config = ConfigDict(extra="forbid")

    scope: Annotated[str, Field(pattern="^(read|track|admin)$")]
    token: Annotated[str, Field(min_length=16, max_length=512)] | None = None
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None


_TOKENS = TypeAdapter(dict[str, _TokenEntry])


@dataclass(frozen=True)
class Token:
    """A token's name and right, and its hash; the token itself is not kept."""

    name: str
    right: Right
    sha256: bytes


def read_tokens(path: Path) -> list[Token]:
    """The tokens of a TOML file, one table each: ``[operator] scope = "track" token = "…"``.

    A token has at least 16 characters; ``sha256`` may replace ``token``.

    Raises:
        RendezviewError: the file is missing or wrong.
    """
    tokens = []
    for name, entry in checked(_TOKENS, read_toml(path, "tokens"), str(path)).items():
        if (entry.token is None) == (entry.sha256 is None):
            raise RendezviewError(f"{path}: {name}: give either token or sha256")
        if entry.token is not None and not _FITS_SOCKET.fullmatch(entry.token):
            raise RendezviewError(
                f"{path}: {name}: token: use only letters, digits and !#$%&'*+-.^_`|~ (a browser "
                "cannot send other characters to a WebSocket)"
            )
        if entry.token is not None:
            digest = hashlib.sha256(entry.token.encode()).digest()
        else:
            digest = bytes.fromhex(entry.sha256 or "")
        tokens.append(Token(name, Right[entry.scope.upper()], digest))
    if not tokens:
        raise RendezviewError(f"{path}: has no token: add one")
    return tokens


class Guard:
    """Refuses wrong hosts and origins, missing tokens and too many requests; adds headers.

    Starlette's TrustedHostMiddleware is not used: it answers 400 in plain text, and this service
    answers every error with its status (here 421) and a `Fault`.
    """

    def __init__(
        self, app: ASGIApp, settings: Settings, tokens: Iterable[Token], metrics: Metrics
    ) -> None:
        self._app = app
        self._tokens = list(tokens)
        self._metrics = metrics
        self._settings = settings
        self._hosts = {settings.host.lower(), *LOOPBACK, *map(str.lower, settings.allowed_hosts)}
        # Names of the machine only: another name may belong to a page of somebody else (DNS
        # rebinding), while an address cannot.
        self._hosts.add(socket.gethostname().lower())
        self._any_address = settings.host in ("0.0.0.0", "::")
        self._bodies = Bodies(settings.bodies_bytes)
        self._uploads = Bodies(settings.uploads_bytes)
        # The rest of the connections is for those without a request, and for health and metrics.
        self._requests = Budget(settings.connections // 2, "requests")
        self._sockets = Budget(settings.connections // 4, "WebSockets")
        self._downloads = Budget(_MOST_DOWNLOADS, "downloads of logs")
        self.budgets = {
            "bodies_bytes": self._bodies.use,
            "uploads_bytes": self._uploads.use,
            "requests": self._requests.use,
            "websockets": self._sockets.use,
            "downloads": self._downloads.use,
        }
        self._callers: OrderedDict[str, TokenBucket] = OrderedDict()  # least recent first

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        budget, share = self._sockets, Share(scope.get("state", {}).get("caller", "?"))
        if scope["type"] == "http":
            budget = self._downloads if scope["path"].endswith("/log") else self._requests
        if refusal is None and scope["path"] not in _ALWAYS:
            try:
                budget.enter(share)
            except HTTPException as full:
                refusal = full.status_code, str(full.detail)
        if refusal is not None:
            await _refuse(scope, receive, send, *refusal)
            self._metrics.requests.labels(str(refusal[0])).inc()
            if refusal[0] == 403 and "caller" in scope.get("state", {}):
                _audit(scope, 403)
            return
        try:
            if scope["type"] == "websocket":
                _audit(scope, "opened")
                channels = Socket(self._bodies, scope, receive, send, share)
                try:
                    await self._app(scope, channels.receive, channels.send)
                finally:
                    channels.close()
            else:
                await self._request(scope, receive, send, share)
        finally:
            budget.leave(share)

    async def _request(self, scope: Scope, receive: Receive, send: Send, share: Share) -> None:
        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                share.end = scope.get(ABORT)
                share.moved_on()
                self._metrics.requests.labels(str(message["status"])).inc()
                _audit(scope, message["status"])
                message["headers"] = [*message["headers"], *HEADERS]
            share.moved(len(message.get("body", b"")))
            await send(message)

        most, uploads = _longest_body(scope, self._settings)
        body = Body(self._uploads if uploads else self._bodies, receive, most, share)
        try:
            await self._app(scope, body, with_headers)
        finally:
            body.close()

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        host = (_split(f"//{headers.get('host', '')}").hostname or "").lower()
        if host not in self._hosts and not (self._any_address and _is_address(host)):
            return 421, "the service does not have this host name: see the setting allowed_hosts"
        origin = headers.get("origin")
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD", "OPTIONS")
        if origin is not None and changes and _split(origin).netloc != headers.get("host"):
            return 403, "pages of other origins may not use the service"
        name, right = self._caller(scope, headers)
        if not self._within_rate(name):
            return 429, "too many requests: wait a moment"
        scope.setdefault("state", {})["right"] = right
        scope["state"]["caller"] = name
        needed = _needed(scope)
        if right is Right.NONE and needed is not Right.NONE:
            return 401, "a token is needed: send it as `Authorization: Bearer TOKEN`"
        if right < needed:
            return 403, f"this token is not enough: use one of scope {needed.name.lower()}"
        if scope["type"] == "http":
            most, _ = _longest_body(scope, self._settings)
            declared = headers.get("content-length", "0")
            if not declared.isdecimal() or int(declared) > most:
                return 413, f"the body is too long: send at most {most} bytes"
        return None

    def _caller(self, scope: Scope, headers: Headers) -> tuple[str, Right]:
        client = scope.get("client")
        address = client[0] if client else "?"
        if not self._tokens:
            return address, Right.ADMIN
        given = _token(headers)
        if given is not None:
            digest = hashlib.sha256(given.encode()).digest()
            for token in self._tokens:
                if hmac.compare_digest(digest, token.sha256):
                    return token.name, token.right
        return address, Right.NONE

    def _within_rate(self, name: str) -> bool:
        """Whether the caller has a request left in its bucket."""
        now_s = time.monotonic()
        rate = self._settings.requests_per_s
        bucket = self._callers.pop(name, None) or TokenBucket.full(rate, now_s)
        self._callers[name] = bucket
        while len(self._callers) > _MOST_CALLERS:
            self._callers.popitem(last=False)
        allowed = bucket.refill(now_s) >= 1.0
        if allowed:
            bucket.spend(1.0)
        return allowed


def _longest_body(scope: Scope, settings: Settings) -> tuple[int, bool]:
    """Bytes of the longest body of a request, and whether it goes to the disk."""
    path = scope["path"]
    if scope["method"] == "PUT" and path.startswith("/v1/models/"):
        return settings.model_bytes, True
    if path == "/v1/jobs":
        return settings.mesh_bytes, True
    if path.endswith("/frames"):
        return settings.frame_bytes, False
    if path.endswith("/measurements"):
        return min(settings.measurement_bytes, settings.frame_bytes), False
    return settings.message_bytes, False


def _audit(scope: Scope, outcome: int | str) -> None:
    """A line of the service's log for what changes something, or takes a log away."""
    path = scope["path"]
    often = path.endswith(("/frames", "/measurements", "/watch", "/flight"))
    reads = scope["type"] == "http" and scope["method"] in ("GET", "HEAD", "OPTIONS")
    if often or (reads and not path.endswith("/log")):
        return
    client = scope.get("client")
    log.info(
        "audit",
        extra={
            "who": scope["state"]["caller"],
            "address": client[0] if client else None,
            "what": f"{scope.get('method', 'WS')} {path[:200]}",
            "outcome": outcome,
        },
    )


def _token(headers: Headers) -> str | None:
    kind, _, value = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer" and value:
        return value.strip()
    for offered in headers.get("sec-websocket-protocol", "").split(","):
        if offered.strip().startswith(TOKEN_SUBPROTOCOL):
            return offered.strip().removeprefix(TOKEN_SUBPROTOCOL)
    return None


def _needed(scope: Scope) -> Right:
    """The right that a request needs; the page's files and the health checks need none."""
    path, is_http = scope["path"], scope["type"] == "http"
    closed = path.startswith("/v1/") or path in ("/metrics", "/openapi.json", "/v1")
    if path in _ALWAYS[:2] or (is_http and not closed):
        return Right.NONE
    looks = scope["method"] in ("GET", "HEAD", "OPTIONS") if is_http else path.endswith("/watch")
    if looks:
        return Right.READ
    return Right.TRACK if path.startswith("/v1/sessions") else Right.ADMIN


def _split(address: str) -> SplitResult:
    """Its parts, empty where it is no address."""
    try:
        return urlsplit(address)
    except ValueError:
        return urlsplit("")


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, error: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        if status == 403 and "right" in scope.get("state", {}):  # so that a browser says why
            offered = SUBPROTOCOL in scope.get("subprotocols", [])
            accepted = SUBPROTOCOL if offered else None
            await send({"type": "websocket.accept", "subprotocol": accepted})
        await send({"type": "websocket.close", "code": 1008, "reason": error})
        return
    extra = {"WWW-Authenticate": "Bearer"} if status == 401 else {}
    answer = fault(status, error, extra)
    answer.raw_headers += HEADERS
    await answer(scope, receive, send)


def fault(
    status: int, error: str, headers: dict[str, str] | None = None, *, again: bool = True
) -> Response:
    """The answer with an error; ``again``: a sender that was refused may repeat its request."""
    extra = dict(headers or {})
    if again and status in (429, 503):
        extra.setdefault("Retry-After", "1")
    text = Fault(error=error, status=status).model_dump_json()
    return Response(text, status, extra, "application/json")
