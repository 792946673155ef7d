"""One file of a log while it is written: created, appended to, checked, forced to disk, ended.

A record counts only if it is in the file that bears the log's name. So each write is followed by
a look at the file itself: it must not be removed, replaced, moved or truncated by somebody else.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import struct
import time
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap_protobuf.schema import build_file_descriptor_set

from rendezview.io.file_lock import lock_if_possible
from rendezview_service.logs import log_schemas
from rendezview_service.logs.log_file import MODEL_ATTACHMENT, SESSION_METADATA, WRITER
from rendezview_service.logs.log_index import MAGIC, Scan, ending, taken
from rendezview_service.logs.log_queue import MOST_AT_ONCE, Entry

_CHECKSUM = struct.Struct("<I")  # at an attachment's end. Source: mcap.dev/spec, "Attachment"
_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)


class Gone(OSError):
    """The file is not what was written under its name any more."""

    def __init__(self, what: str, *, moved: bool = False) -> None:
        super().__init__(0, what)
        self.moved = moved  # it is whole, but under another name


@dataclass(frozen=True, slots=True, eq=False)
class Sync:
    """One fsync of a part, which a thread of its own may run."""

    file: int
    folder: Path | None  # that has its name, if that may not be on the disk yet
    end: int  # what is on the disk afterwards
    states: int

    def run(self) -> None:
        """Run it, once.

        Raises:
            OSError: the disk fails. The system forgets that: never try again with this file.
        """
        try:
            os.fsync(self.file)
            if self.folder is not None:
                _sync_folder(self.folder)
        finally:
            os.close(self.file)


class OpenPart:
    """A part that is being written, by one thread."""

    def __init__(self, path: Path, number: int, beginning: Sequence[bytes], scan: Scan) -> None:
        """Create the file with its beginning, and lock it where the file system has locks.

        Args:
            scan: the index of the beginning.

        Raises:
            FileExistsError: the name is taken; no file is ever written over.
            OSError: it cannot be written; nothing is left of it.
        """
        self.path, self.number, self.scan = path, number, scan
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
        self._file = os.open(path, flags, 0o644)
        try:
            lock_if_possible(self._file)
            _write_all(self._file, beginning)
            status, named = os.fstat(self._file), os.stat(path)
        except OSError:
            os.close(self._file)
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        self._inode = status.st_dev, status.st_ino
        # Some network file systems number their files anew at each look.
        self._known = self._inode == (named.st_dev, named.st_ino)
        self._in_folder = False  # the name itself is on the disk
        self.states = 0
        self.safe_end, self.safe_states = scan.end, 0  # on the disk, by the last fsync
        self.sync_error: OSError | None = None  # of an fsync: the file is not used any more

    def append(self, entries: Sequence[Entry]) -> None:
        """Append entries by one write, all or none.

        Raises:
            Gone: the file is not there any more, or not as it was written.
            OSError: the disk is full or fails.
        """
        more = sum(len(entry.content) for entry in entries)
        try:
            _write_all(self._file, [entry.content for entry in entries])
            self.check(more)
        except OSError as error:
            if isinstance(error, Gone):  # they are at the end, wherever that was
                self._cut(os.fstat(self._file).st_size - more)
            else:
                self._cut(self.scan.end)
            raise
        for entry in entries:
            entry.add_to(self.scan)
            self.states += entry.states

    def check(self, more: int = 0) -> None:
        """See that the file has its name and its length, and ``more`` bytes.

        Raises:
            Gone: it does not.
        """
        status = os.fstat(self._file)
        if status.st_nlink == 0:
            raise Gone("it was removed while it was written")
        if status.st_size != self.scan.end + more:
            raise Gone("it was truncated or written to by another program")
        try:
            named = os.stat(self.path)
        except FileNotFoundError:
            raise Gone("it was moved while it was written", moved=True) from None
        if self._known and (named.st_dev, named.st_ino) != self._inode:
            raise Gone("it was moved while it was written", moved=True)

    @property
    def is_there(self) -> bool:
        """Whether the file has a name, and still all that an fsync has confirmed."""
        try:
            status = os.fstat(self._file)
        except OSError:
            return False
        return status.st_nlink > 0 and status.st_size >= self.safe_end

    def sync(self) -> Sync:
        """What forces all that was appended so far to the disk, and the file's name."""
        folder = None if self._in_folder else self.path.parent
        return Sync(os.dup(self._file), folder, self.scan.end, self.states)

    def remove(self) -> None:
        """Close the file and remove it: nothing is in it."""
        self.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def confirm(self, done: Sync) -> None:
        """It was forced to the disk."""
        self._in_folder = True
        if done.end > self.safe_end:
            self.safe_end, self.safe_states = done.end, done.states

    def finish(self) -> bool:
        """Write the index; False: there is no room for it, and the file is as before."""
        try:
            _write_all(self._file, [ending(self.scan)])
        except OSError:
            self._cut(self.scan.end)
            return False
        return True

    def give_up(self) -> None:
        """Close the file; cut off what no fsync has confirmed, so that it is not there twice."""
        self._cut(self.safe_end)
        self.close()

    def _cut(self, end: int) -> None:
        with contextlib.suppress(OSError):
            if os.fstat(self._file).st_size > end:
                os.ftruncate(self._file, end)

    def close(self) -> None:
        """Give the file up as it is."""
        with contextlib.suppress(OSError):
            os.close(self._file)


def beginning(notes: dict[str, str], model: bytes | None) -> tuple[list[bytes], Scan]:
    """The records before the messages, in pieces, and their index.

    The model, of many megabytes, is not copied.

    Args:
        notes: the metadata of the session.
        model: the model file; None: is not attached.
    """
    builder = RecordBuilder()
    Header("", WRITER).write(builder)
    found = Scan(end=len(MAGIC) + builder.count)

    def add(record: Schema | Channel | Metadata) -> None:
        before = builder.count
        record.write(builder)
        found.add(record, len(MAGIC) + before, builder.count - before)

    for number, (topic, name, kind) in log_schemas.TOPICS.items():
        if kind is None:
            text = json.dumps(log_schemas.json_schema(number)).encode()
            add(Schema(id=number, data=text, encoding="jsonschema", name=name))
        else:
            data = build_file_descriptor_set(kind).SerializeToString()
            add(Schema(id=number, data=data, encoding="protobuf", name=name))
        encoding = "json" if kind is None else "protobuf"
        add(Channel(number, topic, encoding, {}, number))
    add(Metadata(name=SESSION_METADATA, metadata=notes))
    pieces = [MAGIC + taken(builder)]
    if model is not None:
        now_ns, kind = time.time_ns(), "application/octet-stream"
        fields = struct.pack("<QQ", now_ns, now_ns)
        for text in (MODEL_ATTACHMENT.encode(), kind.encode()):
            fields += struct.pack("<I", len(text)) + text
        fields += struct.pack("<Q", len(model))
        length = len(fields) + len(model) + _CHECKSUM.size
        head = struct.pack("<BQ", Opcode.ATTACHMENT, length) + fields
        checksum = _CHECKSUM.pack(zlib.crc32(model, zlib.crc32(fields)))
        attached = Attachment(now_ns, now_ns, MODEL_ATTACHMENT, kind, model)
        found.add(attached, found.end, len(head) + len(model) + len(checksum))
        pieces += [head, model, checksum]
    return pieces, found


def _write_all(file: int, pieces: Sequence[bytes]) -> None:
    left = deque(memoryview(piece) for piece in pieces)
    while left:
        written = os.writev(file, list(islice(left, MOST_AT_ONCE)))
        while left and written >= len(left[0]):
            written -= len(left.popleft())
        if written:
            left[0] = left[0][written:]


def _sync_folder(folder: Path) -> None:
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(file)
