"""A network camera: pictures over HTTP, as MJPEG."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from itertools import count
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from tests.http_server import http_server


@contextmanager
def mjpeg_stream(
    pictures: list[npt.NDArray[np.uint8]], each: int, pause_s: float = 0.0
) -> Iterator[str]:
    """Serve the pictures in turn, ``each`` a connection, and then break off; gives the address."""
    numbers = count()

    class Pictures(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            for _ in range(each):
                content = cv2.imencode(".jpg", pictures[next(numbers) % len(pictures)])[1].tobytes()
                head = (
                    f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
                )
                self.wfile.write(head.encode() + content + b"\r\n")
                time.sleep(pause_s)

        def log_message(self, *_: Any) -> None:
            pass

    with http_server(Pictures) as port:
        yield f"http://user:word@127.0.0.1:{port}/stream.mjpg"
