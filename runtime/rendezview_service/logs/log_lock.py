"""Locks of logs and of their folder. The system removes them with the process that holds them."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where the service does not run
    fcntl = None  # type: ignore[assignment]

_FOLDER_LOCK = ".rendezview.lock"
NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)  # errors of file systems without locks


def lock(descriptor: int) -> bool:
    """Lock an open file for this process; False if another has it.

    Raises:
        OSError: its file system has no locks (`NO_LOCKS`).
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[bool]:
    """Hold the lock of a folder; gives False if another process holds it.

    Raises:
        OSError: the lock's file cannot be made.
    """
    file = os.open(folder / _FOLDER_LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        yield lock(file)
    finally:
        os.close(file)
