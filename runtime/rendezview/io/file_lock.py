"""One process at a time writes a file."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from rendezview.errors import RendezviewError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)  # errors of file systems without locks


def lock(descriptor: int, *, wait: bool = False) -> bool:
    """Lock an open file for this process; False if another has it, unless it is waited for.

    Raises:
        OSError: its file system has no locks (`NO_LOCKS`).
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True


def lock_if_possible(descriptor: int) -> bool | None:
    """Like `lock`; None where the file system has no locks."""
    try:
        return lock(descriptor)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return None


def opened_alone(path: Path) -> BinaryIO:
    """An empty file that this process alone writes; what was in it is gone.

    Raises:
        RendezviewError: another process writes it.
        OSError: it cannot be opened.
    """
    while True:
        file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT, 0o666), "wb")
        try:
            with contextlib.suppress(OSError):  # a file system without locks
                if not lock(file.fileno()):
                    raise RendezviewError(
                        f"{path}: another run is writing it: wait for it, or give another name"
                    )
            if _is_at(file, path):
                if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    file.truncate()
                return file
        except BaseException:
            file.close()
            raise
        file.close()  # its run has ended since, and gave it its name


def _is_at(file: BinaryIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False
