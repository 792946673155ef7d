"""Messages between the service and its workers: a JSON header and some bytes.

Frames do not go this way but through shared memory.
"""

from __future__ import annotations

import os
import socket
import struct
import tempfile
from typing import Any

from pydantic_core import from_json, to_json

_HEAD = struct.Struct("<II")  # lengths of the JSON and of the bytes
Header = dict[str, Any]


def pack(header: Header, content: bytes = b"") -> bytes:
    """One message."""
    text = to_json(header)
    return _HEAD.pack(len(text), len(content)) + text + content


class Unpacker:
    """Builds messages from bytes that arrive in pieces."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[tuple[Header, bytes]]:
        """Add bytes; the messages that are now complete."""
        self._buffer += data
        found = []
        while len(self._buffer) >= _HEAD.size:
            text, content = _HEAD.unpack_from(self._buffer)
            end = _HEAD.size + text + content
            if len(self._buffer) < end:
                break
            header = from_json(self._buffer[_HEAD.size : _HEAD.size + text])
            found.append((header, bytes(self._buffer[_HEAD.size + text : end])))
            del self._buffer[:end]
        return found


def receive(connection: socket.socket) -> tuple[Header, bytes] | None:
    """Wait for the next message; None if the other side is gone."""
    head = _exactly(connection, _HEAD.size)
    if head is None:
        return None
    text, content = _HEAD.unpack(head)
    body = _exactly(connection, text + content)
    if body is None:
        return None
    return from_json(body[:text]), body[text:]


def _exactly(connection: socket.socket, count: int) -> bytes | None:
    parts, missing = [], count
    while missing:
        try:
            part = connection.recv(missing)
        except ConnectionError:
            return None
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def shared_memory(size: int) -> int:
    """A file descriptor of unnamed memory that two processes can map."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("rendezview")
    else:  # macOS
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor
