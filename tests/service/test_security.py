"""Who may do what, and what is refused at the door."""

from __future__ import annotations

import asyncio
import socket
import ssl
from pathlib import Path

import httpx
import numpy as np
import pytest
import trustme
from tests.waiting import MOST_S

from rendezview.errors import RendezviewError
from rendezview_service.client import Client, ServiceError
from rendezview_service.http.security import Guard, Right, read_tokens
from rendezview_service.hub.metrics import Metrics
from rendezview_service.settings import Settings, load_settings

TOKENS = """
[eve]
scope = "read"
token = "eve-may-only-look-here"
[bob]
scope = "track"
token = "bob-may-send-his-frames"
[ann]
scope = "admin"
sha256 = "1d5f4a1e65a9e4a5b6a6c5a2c2b0a28b8a2a8b0a1c5b6d7e8f9a0b1c2d3e4f50"
"""


@pytest.fixture
def tokens_path(tmp_path: Path) -> Path:
    path = tmp_path / "tokens.toml"
    path.write_text(TOKENS)
    return path


def _ask(guard: Guard, path: str, method: str = "GET", **headers: str) -> httpx.Response:
    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(guard, client=("10.0.0.7", 1))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8360") as c:
            named = {k.replace("_", "-"): v for k, v in headers.items()}
            return await c.request(method, path, headers=named)

    return asyncio.run(ask())


async def _says_right(scope, receive, send) -> None:
    body = str(int(scope["state"]["right"])).encode()
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": body})


def _guard(tokens_path: Path | None = None, **settings: object) -> Guard:
    tokens = [] if tokens_path is None else read_tokens(tokens_path)
    return Guard(_says_right, Settings(**settings), tokens, Metrics())


@pytest.mark.requirement("RV-SVC-2")
@pytest.mark.parametrize(
    ("token", "right"),
    [("eve-may-only-look-here", Right.READ), ("bob-may-send-his-frames", Right.TRACK)],
)
def test_a_token_gives_its_right_and_no_more(tokens_path, token, right):
    guard = _guard(tokens_path)
    assert _ask(guard, "/v1/sessions", Authorization=f"Bearer {token}").text == str(int(right))
    offered = {"Sec-WebSocket-Protocol": f"rendezview, token.{token}"}
    assert _ask(guard, "/v1/sessions", **offered).text == str(int(right))


_OWN = {Right.READ: "eve-may-only-look-here", Right.TRACK: "bob-may-send-his-frames"}
_S = "/v1/sessions/s"


@pytest.mark.requirement("RV-SVC-2")
@pytest.mark.parametrize(
    ("needed", "method", "paths"),
    [
        (Right.READ, "GET", ["/v1/models", "/v1/models/m/geometry", "/v1/sessions", f"{_S}/log",
                             "/v1/recordings", "/v1/recordings/a.mcap/log", "/v1/jobs", "/metrics",
                             "/openapi.json", f"{_S}/flight"]),
        (Right.TRACK, "POST", ["/v1/sessions", f"{_S}/frames", f"{_S}/measurements",
                               f"{_S}/orders"]),
        (Right.TRACK, "PUT", [f"{_S}/flight"]),
        (Right.TRACK, "DELETE", [_S]),
        (Right.ADMIN, "POST", ["/v1/jobs", "/v1/models/m/roll", "/v1/recordings", "/v1/others"]),
        (Right.ADMIN, "PUT", ["/v1/models/m"]),
        (Right.ADMIN, "DELETE", ["/v1/models/m", "/v1/jobs/j", "/v1/models/watch"]),
    ],
)  # fmt: skip
def test_a_request_needs_the_right_that_the_docs_name(tokens_path, needed, method, paths):
    guard = _guard(tokens_path)
    for path in paths:
        for right, token in _OWN.items():
            answer = _ask(guard, path, method, Authorization=f"Bearer {token}")
            assert answer.status_code == (200 if right >= needed else 403), (path, right)
            assert right >= needed or f"scope {needed.name.lower()}" in answer.json()["error"]


def test_a_websocket_that_a_token_is_not_enough_for_says_so(tokens_path):
    """A browser gives its page no reason for a refused handshake."""
    passed, guard = [], _guard(tokens_path)

    async def app(scope, receive, send) -> None:
        passed.append(scope["path"])

    guard._app = app

    async def ask(path: str) -> list[dict]:
        sent: list[dict] = []
        headers = [(b"host", b"127.0.0.1"), (b"authorization", b"Bearer eve-may-only-look-here")]
        scope = {"type": "websocket", "path": path, "headers": headers, "subprotocols": []}

        async def receive() -> dict:
            return {"type": "websocket.connect"}

        async def send(message: dict) -> None:
            sent.append(message)

        await guard(scope, receive, send)
        return sent

    assert asyncio.run(ask(f"{_S}/watch")) == []
    accepted, closed = asyncio.run(ask(f"{_S}/stream"))
    assert accepted["type"] == "websocket.accept"
    assert (closed["code"], "scope track" in closed["reason"]) == (1008, True)
    assert passed == [f"{_S}/watch"]


@pytest.mark.parametrize("header", ["", "Bearer", "Bearer x", "Basic ZXZlOg==", "Bearer eve-may"])
def test_without_a_right_token_there_is_health_and_the_page_only(tokens_path, header):
    guard = _guard(tokens_path)
    for path in ("/v1/sessions", "/metrics", "/openapi.json", "/v1/"):
        answer = _ask(guard, path, Authorization=header)
        assert answer.status_code == 401, path
        assert "token" in answer.json()["error"]
    for path in ("/healthz", "/readyz", "/", "/page.js"):
        assert _ask(guard, path, Authorization=header).status_code == 200, path


def test_other_host_names_and_other_pages_are_refused():
    guard = _guard()
    assert _ask(guard, "/healthz", Host="localhost:8360").status_code == 200
    assert _ask(guard, "/healthz", Host="evil.example").status_code == 421
    evil = {"Origin": "http://evil.example"}
    assert _ask(guard, "/v1/sessions", "POST", **evil).status_code == 403
    assert _ask(guard, "/v1/sessions", "DELETE", **evil).status_code == 403
    own = {"Origin": "http://127.0.0.1:8360"}
    assert _ask(guard, "/v1/sessions", "POST", **own).status_code == 200
    named = _guard(allowed_hosts=["lab.example"])
    assert _ask(named, "/healthz", Host="lab.example").status_code == 200


def test_a_service_for_all_addresses_has_no_names_of_others():
    """A page of somebody else may reach it by a name that it controls, not by an address."""
    guard = _guard(host="0.0.0.0", open_to_all=True)
    assert _ask(guard, "/healthz", Host="rebound.example:8360").status_code == 421
    for host in ("10.1.2.3:8360", "[fd00::1]:8360", "localhost", socket.gethostname()):
        assert _ask(guard, "/healthz", Host=host).status_code == 200, host


def test_a_flood_is_held_back():
    guard = _guard(requests_per_s=20.0)
    statuses = [_ask(guard, "/v1/sessions").status_code for _ in range(200)]
    assert statuses[0] == 200
    assert 429 in statuses


def test_every_answer_says_what_a_browser_may_do_with_it():
    answer = _ask(_guard(), "/healthz")
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "text", ["", "x = 1", "[a]\nscope='king'\ntoken='0123456789abcdef'", "[a]\nscope='read'", "[[",
             "[a]\nscope='read'\ntoken='short'", "[a]\nscope='read'\ntoken='one with spaces in it'",
             "[a]\nscope='read'\ntoken='größer-als-sechzehn'"],
)  # fmt: skip
def test_wrong_tokens_files_are_refused(tmp_path, text):
    path = tmp_path / "tokens.toml"
    path.write_text(text)
    with pytest.raises(RendezviewError, match=r"tokens\.toml"):
        read_tokens(path)


def test_settings_come_from_flags_then_environment_then_file(tmp_path, monkeypatch):
    path = tmp_path / "service.toml"
    path.write_text('port = 1000\nworkers = 3\nlog_level = "debug"\n')
    monkeypatch.setenv("RENDEZVIEW_SERVE_PORT", "2000")
    monkeypatch.setenv("RENDEZVIEW_SERVE_WORKERS", "4")
    settings = load_settings(path, {"port": 3000, "workers": None})
    assert (settings.port, settings.workers, settings.log_level) == (3000, 4, "debug")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ({"host": "0.0.0.0"}, "--tokens"),
        ({"tls_certificate": Path("x.pem")}, "--tls-key"),
        ({"port": 99999}, "port"),
        ({"sync": "sometimes"}, "sync"),
    ],
)
def test_impossible_settings_are_refused(flags, said):
    with pytest.raises(RendezviewError, match=said):
        load_settings(None, flags)


def test_unknown_settings_are_refused(tmp_path):
    path = tmp_path / "service.toml"
    path.write_text("prot = 1000\n")
    with pytest.raises(RendezviewError, match="prot: unknown key"):
        load_settings(path, {})


def test_a_service_with_tokens_and_a_certificate_lets_each_do_his_part(
    start_service, tokens_path, camera, tmp_path
):
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1")
    known, chain, key = (tmp_path / name for name in ("known.pem", "chain.pem", "key.pem"))
    authority.cert_pem.write_to_path(str(known))
    chain.write_bytes(b"".join(blob.bytes() for blob in issued.cert_chain_pems))
    issued.private_key_pem.write_to_path(str(key))
    served = start_service(
        "--tls-certificate", str(chain), "--tls-key", str(key), "--tokens", str(tokens_path)
    )
    assert served.url.startswith("https://127.0.0.1")
    with Client(served.url) as stranger, pytest.raises(RendezviewError, match="CERTIFICATE"):
        stranger.sessions()
    plain = served.url.replace("https", "http")
    with Client(plain) as client, pytest.raises(RendezviewError, match="cannot be reached"):
        client.sessions()

    address = ("127.0.0.1", int(served.url.rstrip("/").rpartition(":")[2]))
    trusted = ssl.create_default_context(cafile=str(known))
    with trusted.wrap_socket(socket.create_connection(address), server_hostname="127.0.0.1") as own:
        own.sendall(b"GET /healthz HTTP/1.1\r\nHost: here\r\n\r\n")
        assert own.recv(1000).startswith(b"HTTP/1.1 ")
        assert not own.session.has_ticket  # one that comes while a thread writes can stop it

    def client_of(token: str | None) -> Client:
        return Client(served.url, token, certificate=known)

    with client_of(None) as nobody, pytest.raises(ServiceError) as refused:
        nobody.sessions()
    assert refused.value.status == 401
    with client_of("eve-may-only-look-here") as eve:
        assert eve.sessions() == []
        with pytest.raises(ServiceError, match="scope track"):
            eve.open(camera)
    with client_of("bob-may-send-his-frames") as bob:
        session = bob.open(camera)
        with pytest.raises(ServiceError, match="scope admin"):
            bob.send_model("mine", tokens_path)
        black = np.zeros((camera.height, camera.width), np.uint8)
        assert session.track(black, 0.0)["status"] == "empty"
        with session.stream() as stream:
            stream.send(b"\x89PNG\r\n\x1a\n" + bytes(50))
            with pytest.raises(ServiceError, match="cut short"):
                stream.receive(MOST_S)
            stream.send(black, 1.0)
            assert stream.receive(MOST_S)["frame"] == 1
        session.close()
    served.stop()
    assert served.process.returncode == 0
    assert not any("eve-may" in line or "bob-may" in line for line in served.lines)


def test_what_is_no_certificate_is_refused(tmp_path):
    wrong = tmp_path / "wrong.pem"
    wrong.write_text("no certificate")
    for path in (wrong, tmp_path / "nothing.pem"):
        with pytest.raises(RendezviewError, match=r"\.pem: not a certificate"):
            Client("https://127.0.0.1:8360", certificate=path)
