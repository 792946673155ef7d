"""What comes before any token: slow, long and wrong requests, over real sockets."""

from __future__ import annotations

import contextlib
import json
import zipfile

import httpx
import pytest
from tests.service.hostile_clients import connected, resident_mb
from tests.waiting import MOST_S

from rendezview.errors import RendezviewError
from rendezview_ground.mesh import containers as mesh_containers
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_service.http.connections import HEAD_S, MOST_HEAD

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


# No connection is closed for its age: those that are have made room.
NO_HURRY = """
import sys
if "serve" in sys.orig_argv:
    import rendezview_service.http.connections as connections
    connections.HEAD_S = 1e6
"""


@pytest.fixture(scope="module")
def guarded(start_service, tmp_path_factory):
    """With a token, so that nothing here is from somebody who is known."""
    folder = tmp_path_factory.mktemp("tokens")
    tokens = folder / "tokens.toml"
    tokens.write_text('[ann]\nscope = "admin"\ntoken = "nobody-here-has-this-one"\n')
    served = start_service(
        "--tokens", str(tokens), given=False, before=NO_HURRY, RENDEZVIEW_SERVE_CONNECTIONS="40",
    )  # fmt: skip
    yield served
    served.stop()


def _is_alive(served) -> bool:
    return httpx.get(f"{served.url}healthz", timeout=MOST_S).status_code == 200


def test_half_open_connections_do_not_keep_others_out(guarded):
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(connected(guarded.url)) for _ in range(120)]
        for k, connection in enumerate(held[60:]):
            with contextlib.suppress(OSError):
                connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "[: 20 + k % 30])
        assert _is_alive(guarded)
        for connection in held[:60]:  # the first ones had to make room
            assert connection.recv(1) == b""
    assert HEAD_S <= 10.0


def test_a_head_that_does_not_end_is_cut_off(guarded):
    before_mb = resident_mb(guarded.process.pid)
    sent = 0
    with connected(guarded.url) as connection, contextlib.suppress(OSError):
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: ")
        while sent < 66_000_000:
            connection.sendall(bytes(65_536).replace(b"\0", b"a"))
            sent += 65_536
    assert sent < 20_000_000  # what the system's buffers take
    assert resident_mb(guarded.process.pid) - before_mb < 20.0
    with connected(guarded.url) as connection:
        headers = b"".join(b"X-%d: %s\r\n" % (k, b"a" * 1000) for k in range(70))
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n" + headers + b"\r\n")
        assert b" 400 " in connection.recv(100)
    assert len(headers) > MOST_HEAD
    assert _is_alive(guarded)


@pytest.mark.parametrize("origin", ["http://[", "http://[::1", "null", "//", "http://evil.example"])
def test_an_origin_that_is_none_is_refused(guarded, origin):
    answer = httpx.post(f"{guarded.url}v1/sessions", headers={"Origin": origin}, content=b"{}")
    assert answer.status_code == 403


def test_a_long_message_is_refused_before_it_is_read(service):
    """Declared, and in chunks without a length."""
    text = json.dumps({"id": "a" * 3_000_000}).encode()
    for content in (text, (text[k : k + 65_536] for k in range(0, len(text), 65_536))):
        answer = httpx.post(f"{service.url}v1/sessions", content=content, timeout=MOST_S)
        assert answer.status_code == 413
        assert "at most 1000000 bytes" in answer.json()["error"]


def test_a_mesh_opens_nothing_outside_its_folder(tmp_path):
    secret = tmp_path / "secret.mtl"
    secret.write_text("newmtl red\nKd 1 0 0\n")
    folder = tmp_path / "upload"
    folder.mkdir()
    (folder / "link.mtl").symlink_to(secret)
    for library in (str(secret), "../secret.mtl", "link.mtl", "/etc/passwd"):
        mesh = folder / "sat.obj"
        mesh.write_text(f"mtllib {library}\n{TRIANGLE}usemtl red\nf 1 2 3\n")
        loaded = load_mesh(mesh, "m")
        assert loaded.face_rgb[0].tolist() == pytest.approx([0.6] * 3)
    (folder / "secret.mtl").write_text(secret.read_text())  # beside it: read
    mesh.write_text(f"mtllib {secret}\n{TRIANGLE}usemtl red\nf 1 2 3\n")
    assert load_mesh(mesh, "m").face_rgb[0].tolist() == pytest.approx([1.0, 0.0, 0.0])


def test_an_archive_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(
    tmp_path, monkeypatch
):
    """The limit is lowered, so that making one is quick."""
    monkeypatch.setattr(mesh_containers, "_MOST_UNPACKED", 20_000_000)
    bomb = tmp_path / "bomb.3mf"
    with (
        zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("3D/3dmodel.model", "w", force_zip64=True) as part,
    ):
        part.write(bytes(22_000_000))
    assert bomb.stat().st_size < 200_000
    opened: list[object] = []
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda _, name, *more: opened.append(name))
    with pytest.raises(RendezviewError, match="unpacks to"):
        load_mesh(bomb)
    assert opened == []
