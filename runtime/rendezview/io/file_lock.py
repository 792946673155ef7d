"""One process at a time writes a file, or into a folder.

The system takes a lock back when the process ends that holds it, however it ends.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Self

from rendezview.errors import RendezviewError
from rendezview.io.files import make_folder

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# Errors of file systems without locks; EBADF: NFS locks no folder.
NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EBADF)
_LOCKS = Path("/proc/locks")  # of Linux
_WORDS = 80  # characters of a command line in a message. Source: chosen to fit a line


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


def _holder(descriptor: int) -> str:
    """Which process has locked an open file, in brackets; nothing where the system does not say."""
    inode = str(os.fstat(descriptor).st_ino)
    with contextlib.suppress(OSError, IndexError):
        for line in _LOCKS.read_text().splitlines():
            # 1: FLOCK  ADVISORY  WRITE 7448 fe:00:2148015 0 EOF; one that waits has an arrow
            words = line.split()
            if words[1] == "FLOCK" and words[5].rsplit(":")[-1] == inode:
                return f" (process {words[4]}{_command_line(words[4])})"
    return ""


def _command_line(process: str) -> str:
    """``: rendezview track …``; nothing for a process of another user or machine."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_text(errors="replace").split("\0")
    except OSError:
        return ""
    if Path(words[0]).name.startswith("python"):
        del words[0]
    text = " ".join([Path(word).name for word in words[:1]] + words[1:]).strip()
    return f": {text[:_WORDS]}{'…' if len(text) > _WORDS else ''}" if text else ""


def opened_alone(path: Path, name: Path | None = None) -> BinaryIO:
    """An empty file that this process alone writes; what was in it is gone.

    Args:
        path: of the file.
        name: of what it will be, for the message.

    Raises:
        RendezviewError: another process writes it.
        OSError: it cannot be opened.
    """
    while True:
        file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT, 0o666), "wb")
        try:
            _lock_or_refuse(file.fileno(), name or path)
            if _is_at(file.fileno(), path):
                if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    file.truncate()
                return file
        except BaseException:
            file.close()
            raise
        file.close()  # its run has ended since, and gave it its name


def give_name(file: BinaryIO, partial: Path, path: Path) -> None:
    """Rename a complete file of `opened_alone` while nobody else can open it so; close it.

    Raises:
        OSError: it cannot be renamed.
    """
    with file:
        if fcntl is None:
            file.close()  # Windows renames no open file
        os.replace(partial, path)


class FolderLock:
    """Meanwhile no other run writes into a folder, which is made if it does not exist.

    A file system without locks of folders protects nothing.

    Args:
        folder: what is locked.
        name: of what is written there, for the message.

    Raises:
        RendezviewError: another run writes there, or the folder cannot be made.
    """

    def __init__(self, folder: Path, name: Path | None = None) -> None:
        self._close: Callable[[], object] | None = None
        make_folder(folder)
        while fcntl is not None and self._close is None:
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                _lock_or_refuse(descriptor, name or folder)
                if _is_at(descriptor, folder):
                    self._close = weakref.finalize(self, os.close, descriptor)
            finally:
                if self._close is None:  # or its run has ended since, and removed it
                    os.close(descriptor)
                    make_folder(folder)

    def release(self) -> None:
        """Let others write there. Releasing again does nothing."""
        if self._close is not None:
            self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def _lock_or_refuse(descriptor: int, name: Path) -> None:
    if lock_if_possible(descriptor) is False:
        raise RendezviewError(
            f"{name}: another run is writing it{_holder(descriptor)}: wait for it, or give another "
            "name"
        )


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
