"""Pictures of a run in a browser on the same machine, as they are drawn: ``track --show``."""

from __future__ import annotations

import sys
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

_PAGE = (
    b"<!doctype html><title>rendezview</title><body style='margin:0;background:#000'>"
    b"<img src='/pictures' alt='the run, as it is drawn' "
    b"style='width:100vw;height:100vh;object-fit:contain'>"
)
_BOUNDARY = b"picture"
_WAIT_S = 1.0  # s; a viewer learns of the end so late at most. Source: a chosen limit
_QUALITY = 85  # of JPEG. Source: by construction, edges are clean


class QuietServer(ThreadingHTTPServer):
    """A server to whom a client that has gone is no fault."""

    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Any other fault is one."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class LiveView:
    """The newest picture of a run, to all browsers that look. Viewers never hold up the run."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._picture, self._number, self._ended = b"", 0, False
        self._server = QuietServer(("127.0.0.1", 0), self._handler())
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        """Where to look."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        """The next picture, (H, W, 3) blue, green, red."""
        packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        with self._changed:
            self._picture, self._number = packed, self._number + 1
            self._changed.notify_all()

    def _next(self, last: int) -> tuple[bytes, int] | None:
        """The first picture after one, with its number; None at the end."""
        with self._changed:
            while self._number == last and not self._ended:
                self._changed.wait(_WAIT_S)
            return None if self._number == last else (self._picture, self._number)

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        view = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/pictures":
                    self._pictures()
                    return
                known = self.path == "/"
                self.send_response(HTTPStatus.OK if known else HTTPStatus.NOT_FOUND)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.end_headers()
                self.wfile.write(_PAGE if known else b"only / is here")

            def _pictures(self) -> None:
                self.send_response(HTTPStatus.OK)
                kind = f"multipart/x-mixed-replace; boundary={_BOUNDARY.decode()}"
                self.send_header("Content-Type", kind)
                self.end_headers()
                number = 0
                while (found := view._next(number)) is not None:
                    picture, number = found
                    head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
                    self.wfile.write(head % (_BOUNDARY, len(picture)) + picture + b"\r\n")

            def log_message(self, *_: object) -> None:
                """Nothing: the screen is the run's."""

        return Handler
