"""Requests to every route with every method, and bytes to the socket itself, for `fuzz`."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import quote

import numpy as np
from tests.waiting import MOST_S

METHODS = ("GET", "HEAD", "POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "BREW")
_KINDS = (
    "application/json", "application/octet-stream", "image/png", "multipart/form-data", "text/xml",
    "application/x-ndjson", "x/" + "y" * 500, "",
)  # fmt: skip
_HEADERS = (
    "Host", "Origin", "Authorization", "X-Sender", "Range", "If-None-Match", "Content-Encoding",
    "Expect", "Upgrade", "Sec-WebSocket-Protocol", "Accept", "Cookie", "X-Forwarded-For", "TE",
)  # fmt: skip
_WORDS = (
    "http://[", "[::1", "127.0.0.1", "localhost:99999999", "Bearer " + "x" * 3000, "bytes=0-0,5-",
    "gzip, br", "100-continue", "websocket", "token.x, rendezview", "*/*;q=9999", "a=b; " * 9,
    "\xff\xfe", "", "null", "chunked", "-1", "0" * 400, "\xf0\x9f\x92\xa5",
)  # fmt: skip
_PAGE = (
    "/", "/index.html", "/main.js", "/vendor/three.js", "/../main.py", "/%2e%2e/%2e%2e/etc/passwd",
    "/docs", "/openapi.json", "/" + "a/" * 2000, "/%00", "/%ff", "//", "/v1", "/metrics?x=yyyy",
)  # fmt: skip

Value = Callable[[], object]


class Routes:
    """Draws requests to the routes of an OpenAPI description, and to what it does not describe."""

    def __init__(self, description: dict[str, Any], rng: np.random.Generator, value: Value) -> None:
        self._paths: dict[str, Any] = description["paths"]
        self._rng = rng
        self._value = value

    def request(
        self, session: str, frame: Callable[[], bytes]
    ) -> tuple[str, str, bytes | None, dict[str, str]]:
        """Method, path with query, body and headers; the session itself is never deleted."""
        rng = self._rng
        path = str(rng.choice([*self._paths, *_PAGE]))
        known = self._paths.get(path, {})
        method = str(rng.choice(list(known) if known and rng.random() < 0.6 else METHODS)).upper()
        names = [p["name"] for p in known.get(method.lower(), {}).get("parameters", [])]

        def filled(found: re.Match[str]) -> str:
            if found[0] == "{name}" and rng.random() < 0.6:
                return session
            return quote(str(self._value())[:300], safe="") or "x"

        place = re.sub(r"\{\w+\}", filled, path)
        asked = [n for n in names if "{" + n + "}" not in path and rng.random() < 0.6]
        asked += [str(self._value())[:50] for _ in range(rng.choice([0, 0, 0, 2]))]
        query = "&".join(f"{quote(n)}={quote(str(self._value())[:300])}" for n in asked)
        if method == "DELETE" and place == f"/v1/sessions/{session}":
            method = "GET"
        if method == "POST" and place == "/v1/jobs":  # a training is tried apart: it may take long
            query = query.replace("model=", "model=..%2F")
        headers = {"Content-Type": str(rng.choice(_KINDS))}
        for _ in range(rng.choice([0, 0, 1, 3])):
            headers[str(rng.choice(_HEADERS))] = str(rng.choice(_WORDS))
        body = None
        if method in ("POST", "PUT", "PATCH", "DELETE"):
            body = frame() if rng.random() < 0.5 else json.dumps(self._value()).encode()
        return method, place + (f"?{query}" if query else ""), body, headers


_GOOD = (
    b"GET /v1/sessions HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"POST /v1/sessions HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    b'Content-Length: 12\r\n\r\n{"id": "x%%"}',
    b"POST /v1/sessions/x/frames HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n"
    b"5\r\nhello\r\n0\r\n\r\n",
    b"GET /v1/sessions/fuzzed/watch HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n\x81\x85\0\0\0\0hello\x88\x80\0\0\0\0",
    b"GET /v1/sessions/fuzzed/stream HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n\x82\xff\x7f\xff\xff\xff\xff\xff\xff\xff",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 20,
    b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 70_000 + b"\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 12_000 + b"\r\n",
    b"GET /" + b"z" * 70_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
    b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999999999999999\r\n\r\n",
    b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 4\r\n"
    b"Content-Length: 5\r\n\r\nabcd",
    b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 4\r\n"
    b"Transfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\n",
)  # fmt: skip


def raw_bytes(rng: np.random.Generator) -> bytes:
    """Bytes for the socket: a request with changes, or none at all."""
    if rng.random() < 0.1:
        return bytes(rng.bytes(rng.integers(1, 3000)))
    content = bytearray(_GOOD[rng.integers(len(_GOOD))])
    for _ in range(rng.integers(0, 4)):
        how, place = rng.integers(4), int(rng.integers(0, len(content) + 1))
        if how == 0:
            content = content[:place]
        elif how == 1:
            content[place:place] = rng.bytes(rng.integers(1, 20))
        elif how == 2:
            content[place : place + 1] = bytes([rng.integers(256)])
        else:
            content[place:place] = content[int(rng.integers(0, len(content) + 1)) :][:500]
    return bytes(content)


def send_raw(address: tuple[str, int], content: bytes, held: list[socket.socket]) -> str:
    """What became of bytes that were sent; some connections stay open in ``held``."""
    connection = socket.create_connection(address, timeout=MOST_S)
    try:
        connection.sendall(content)
        connection.settimeout(0.02)
        answer = connection.recv(4096)
    except TimeoutError:  # an answer needs more bytes: the connection stays half open
        held.append(connection)
        return "raw: waits"
    except OSError:
        connection.close()
        return "raw: cut off"
    connection.close()
    return f"raw: {answer[9:12].decode('latin-1')}" if answer else "raw: closed"
