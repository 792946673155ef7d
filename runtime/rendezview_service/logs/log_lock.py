"""Locks of logs and folders, which the system removes with the process that holds them.

Temporary folders are locked so that the next process removes those of one that was killed.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

from rendezview.io.file_lock import lock, lock_if_possible

_FOLDER_LOCK = ".rendezview.lock"
_HELD = ".held"  # locked while the process lives that made the folder


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


class TemporaryFolder:
    """A new folder among the system's temporary files; it goes with this object or process.

    Args:
        prefix: of its name. Older folders of that prefix which no process holds are removed.
    """

    def __init__(self, prefix: str) -> None:
        for left in Path(tempfile.gettempdir()).glob(f"{prefix}*/{_HELD}"):
            _remove_unheld(left)
        self.path = Path(tempfile.mkdtemp(prefix=prefix))
        new = self.path / f"{_HELD}.new"
        held = os.open(new, os.O_RDWR | os.O_CREAT, 0o600)
        self.remove = weakref.finalize(self, _remove, self.path, held)
        if lock_if_possible(held):
            new.rename(new.with_name(_HELD))  # under its name it is locked: nobody takes it


def _remove(folder: Path, held: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.close(held)


def _remove_unheld(held: Path) -> None:
    """Remove a folder if no process holds it; one of another user is left alone."""
    try:
        file = os.open(held, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return
    try:
        if os.fstat(file).st_uid == os.geteuid() and lock(file):
            shutil.rmtree(held.parent, ignore_errors=True)
    except OSError:
        return
    finally:
        os.close(file)
