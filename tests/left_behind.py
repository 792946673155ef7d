"""Processes that the tests started, and that outlive them."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

_MARK = "RENDEZVIEW_TEST_PROCESS"  # in the environment of all that descends from this process
_TRACKER = b"resource_tracker"  # of multiprocessing and joblib: ends with the process it watches


@contextlib.contextmanager
def none_left_behind(ends_s: float = 60.0) -> Iterator[None]:
    """Fails where a process that was started inside still runs at the end, orphans included.

    They are killed. Nothing is checked where there is no ``/proc``.

    Args:
        ends_s: s, for processes that are ending.
    """
    around = os.environ.get(_MARK, "")
    os.environ[_MARK] = f"{os.getpid()}-{time.monotonic_ns()}"
    mark = f"{_MARK}={os.environ[_MARK]}".encode()
    yield
    os.environ[_MARK] = around
    pool = sys.modules.get("joblib.externals.loky.reusable_executor")
    if pool is not None and pool._executor is not None:  # its processes wait for more work
        pool._executor.shutdown(wait=True)
    end_s = time.monotonic() + ends_s
    while (left := _running(mark)) and time.monotonic() < end_s:
        time.sleep(0.1)
    for pid in left:
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)
    assert not left, f"left behind, and killed: {left}"


def _running(mark: bytes) -> dict[int, str]:
    """Commands of running processes with the mark, by number."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                command = (folder / "cmdline").read_bytes()
                if _TRACKER not in command:
                    found[int(folder.name)] = command.replace(b"\0", b" ").decode(errors="replace")
    return found
