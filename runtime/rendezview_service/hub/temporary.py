"""Temporary folders, removed even where the process that made them was killed: by the next one."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from pathlib import Path

from rendezview_service.logs.log_lock import NO_LOCKS, lock

_HELD = ".held"  # locked while the process lives that made the folder


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
        try:
            lock(held)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
        else:
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
