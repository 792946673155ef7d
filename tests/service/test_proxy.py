"""The service behind Caddy, as `deploy/Caddyfile` sets it up; skipped without Caddy."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from tests.service.served import Served
from tests.waiting import MOST_S, free_port, wait_until

from rendezview_service.client import Client

CADDYFILE = Path(__file__).resolve().parents[2] / "deploy" / "Caddyfile"
TOKEN = "behind-the-proxy-0123"


@pytest.fixture(scope="module")
def proxied(start_service, tmp_path_factory) -> Iterator[tuple[str, Path, Served]]:
    """The proxy's address, the certificate of its authority, and the service."""
    caddy = shutil.which("caddy")
    if caddy is None:
        pytest.skip("no Caddy: apt-get install caddy")
    folder = tmp_path_factory.mktemp("caddy")
    tokens = folder / "tokens.toml"
    tokens.write_text(f'[ann]\nscope = "admin"\ntoken = "{TOKEN}"\n')
    served = start_service("--tokens", str(tokens), "--record", str(folder))
    ports = [free_port(), free_port()]
    environment = os.environ | {
        "RENDEZVIEW_NAME": f"localhost:{ports[0]}",
        "RENDEZVIEW_HTTP_PORT": str(ports[1]),
        "RENDEZVIEW_SERVICE": served.url.removeprefix("http://").rstrip("/"),
        "XDG_DATA_HOME": str(folder),
        "XDG_CONFIG_HOME": str(folder),
        "HOME": str(folder),
    }
    command = [caddy, "run", "--adapter", "caddyfile", "--config", "-"]
    # Its own endpoint for changes would need a port of its own.
    text = CADDYFILE.read_text().replace("{\n", "{\n\tadmin off\n\tskip_install_trust\n", 1)
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, text=True
    )
    assert process.stdin is not None
    process.stdin.write(text)
    process.stdin.close()
    root = folder / "caddy" / "pki" / "authorities" / "local" / "root.crt"
    wait_until(lambda: process.poll() is not None or _serves(ports[0], root))
    assert process.poll() is None
    yield f"https://localhost:{ports[0]}", root, served
    process.terminate()
    process.wait(MOST_S)


def _serves(port: int, root: Path) -> bool:
    """Whether there is a certificate yet; the port is open before."""
    if not root.exists():
        return False
    with (
        contextlib.suppress(OSError),  # ssl.SSLError is one
        socket.create_connection(("localhost", port), 1.0) as plain,
        ssl.create_default_context(cafile=root).wrap_socket(plain, server_hostname="localhost"),
    ):
        return True
    return False


def test_frames_streams_and_logs_pass_the_proxy(proxied, camera, tour) -> None:
    url, root, served = proxied
    with Client(url, TOKEN, MOST_S, root) as client, client.open(camera, name="p") as session:
        assert session.track(tour[0][2], 0.0)["pose"] is not None
        with session.stream() as stream:
            for time_s, _, image in tour[1:4]:
                stream.send(image, time_s)
                assert stream.receive(MOST_S)["frame"] > 0
        assert session.log().startswith(b"\x89MCAP0\r\n")
    said = [json.loads(line) for line in served.lines if '"audit"' in line]
    assert any(line["who"] == "ann" and line["what"] == "POST /v1/sessions" for line in said)


def test_the_proxy_bounds_bodies_and_heads_and_passes_refusals(proxied) -> None:
    url, root, _ = proxied
    with httpx.Client(verify=ssl.create_default_context(cafile=root), timeout=MOST_S) as http:
        assert http.get(f"{url}/").status_code == 200
        assert http.get(f"{url}/v1/sessions").status_code == 401
        token = {"Authorization": f"Bearer {TOKEN}"}
        refused = http.post(
            f"{url}/v1/sessions", headers=token | {"Origin": "https://elsewhere.example"}, json={}
        )
        assert refused.status_code == 403
        long = http.get(f"{url}/healthz", headers={"X-Long": "a" * 200_000})
        assert long.status_code == 431
        large = http.post(f"{url}/v1/sessions/p/frames", headers=token, content=bytes(33_000_000))
        assert large.status_code in (404, 413)  # before the session is looked for, or after
