"""Silences OpenCV's own messages."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

import cv2


@contextlib.contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's own messages: our error describes the fault. Threads may overlap."""
    _silence.enter()
    try:
        yield
    finally:
        _silence.leave()


class _Silence:
    """OpenCV's log level, which is global: the first thread silences it, the last restores it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = 0
        self._level = 0

    def enter(self) -> None:
        with self._lock:
            if self._threads == 0:
                self._level = cv2.utils.logging.getLogLevel()
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            self._threads += 1

    def leave(self) -> None:
        with self._lock:
            self._threads -= 1
            if self._threads == 0:
                cv2.utils.logging.setLogLevel(self._level)


_silence = _Silence()
