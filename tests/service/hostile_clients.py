"""What clients send that take what they can; of tests, and of experiment service-faults."""

from __future__ import annotations

import json
import socket
import struct
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from tests.service.logged import settings_of
from tests.waiting import MOST_S

from rendezview.geometry.camera import Camera
from rendezview_service.logs.recording import LogWriter

LOG = "large.mcap"  # a recording


def large_log(path: Path, camera: Camera, megabytes: int) -> int:
    """A log of pictures that cannot be packed, written beside the service; its length."""
    writer = LogWriter(path, camera, {}, None, settings_of(compression="", log_wait_s=MOST_S))
    picture = np.random.default_rng(1).bytes(1_000_000)
    for k in range(megabytes):
        state = {"frame": k, "time_s": float(k), "received_unix_s": 1.7e9 + k, "pose": None}
        writer.write(state, json.dumps(state).encode(), picture)
    writer.close()
    return path.stat().st_size


def connected(url: str) -> socket.socket:
    """A connection to a service."""
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname or "", parts.port or 0), timeout=MOST_S)


def resident_mb(pid: int) -> float:
    """Memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 1e6


def head(path: str, length: int | None = None, method: str = "POST", more: str = "") -> bytes:
    """The head of a request."""
    more += "" if length is None else f"Content-Length: {length}\r\n"
    kind = "Content-Type: application/json\r\n"
    return f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{kind}{more}\r\n".encode()


def upgrade(session: str) -> bytes:
    """The head of a stream."""
    more = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    more += "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    return head(f"/v1/sessions/{session}/stream", None, "GET", more)


def begin_message(connection: socket.socket, session: str, length: int, sent: int) -> None:
    """Open a stream, and send the beginning of a message."""
    connection.sendall(upgrade(session))
    connection.recv(1000)
    connection.sendall(b"\x82\xff" + struct.pack(">Q", length) + bytes(4) + bytes(sent))
