"""Waiting for an event, however busy the machine is."""

from __future__ import annotations

import contextlib
import random
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

MOST_S = 600.0  # A guard against hangs, where loops have to be compiled first too.
_PAUSE_S, _MOST_PAUSE_S = 0.02, 0.2
_PAUSE_SHARE = 0.05  # of the wait so far: asking 50 times a second takes half a core from the work

_PORTS = range(20_000, 30_000)  # below those that the system gives to connections of others

Value = TypeVar("Value")


def wait_until(happened: Callable[[], Value], said: Callable[[], object] = lambda: "") -> Value:
    """The first value of ``happened`` that is true.

    Args:
        said: what the failure shows, if it never is.
    """
    start_s = time.monotonic()
    while not (value := happened()):
        waited_s = time.monotonic() - start_s
        assert waited_s < MOST_S, said()
        time.sleep(min(max(_PAUSE_S, _PAUSE_SHARE * waited_s), _MOST_PAUSE_S))
    return value


@contextlib.contextmanager
def ends_in_time(process: subprocess.Popen[Any]) -> Iterator[None]:
    """Whoever reads the lines of a process inside reads their end: after `MOST_S` it is killed."""
    timer = threading.Timer(MOST_S, process.kill)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    while True:
        port = random.SystemRandom().choice(_PORTS)
        with socket.socket() as trial:
            if trial.connect_ex(("127.0.0.1", port)) != 0:
                return port
