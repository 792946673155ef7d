"""A small HTTP server of a test's own, which has ended with all its threads when the test has."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler

from rendezview.cli.live_view import QuietServer


class _Server(QuietServer):
    daemon_threads = False  # closing it waits for them: what one says is no other test's


@contextmanager
def http_server(handler: Callable[..., BaseHTTPRequestHandler]) -> Iterator[int]:
    """Serve on a port of this machine, which it gives."""
    server = _Server(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
