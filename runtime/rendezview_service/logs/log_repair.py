"""Logs put together from their intact parts: to repair one, or to send all parts of a session.

Nothing is written over: a repaired log is a new file, which takes the place of the old one only if
it has everything that the old one had.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    MessageIndex,
    Schema,
)

from rendezview.errors import RendezviewError
from rendezview.io.file_lock import lock
from rendezview.io.files import atomic_write
from rendezview_service.logs.log_file import content_of, is_finished, reading, records
from rendezview_service.logs.log_index import MAGIC, Scan, chunk_index, ending, taken

_COPY_BYTES = 1 << 16  # bytes per piece of a copy. Source: chosen
_MESSAGE = struct.Struct("<BQHIQ")  # opcode, length, channel, sequence, log time of a message
_HEAD_BYTES = 9  # of a record: opcode, length. Source: mcap.dev/spec, "Records"
RECOVERED = ".recovered"  # in the name of a repaired copy of a damaged log


@dataclass(frozen=True, slots=True)
class LogPart:
    """A file of a log."""

    path: Path
    size: int | None = None  # bytes that are complete; None: to the end of the file


@dataclass(slots=True, eq=False)
class Joined:
    """The intact records of a log's parts, as one file that is not written yet."""

    found: Scan = field(default_factory=Scan)  # its index; `found.end` is its length so far
    pieces: list[tuple[Path, int, int] | bytes] = field(default_factory=lambda: [MAGIC])
    damaged_bytes: int = 0  # left out between intact records
    cut_bytes: int = 0  # left out after the last intact record of a part

    def blocks(self) -> Iterator[bytes]:
        """The file in blocks, its ending included. Its parts are opened with the first one."""
        with contextlib.ExitStack() as stack:
            paths = {piece[0] for piece in self.pieces if isinstance(piece, tuple)}
            files = {path: stack.enter_context(open(path, "rb")) for path in paths}
            for piece in self.pieces:
                if isinstance(piece, bytes):
                    yield piece
                    continue
                path, start, end = piece
                files[path].seek(start)
                while start < end and (block := files[path].read(min(end - start, _COPY_BYTES))):
                    start += len(block)
                    yield block
        yield ending(self.found)

    @property
    def length(self) -> int:
        """Number of bytes of `blocks`."""
        return self.found.end + len(ending(self.found))

    def copy(self, path: Path, start: int, length: int) -> None:
        """Add a range of a file."""
        last = self.pieces[-1]
        if isinstance(last, tuple) and last[0] == path and last[2] == start:
            self.pieces[-1] = (path, last[1], start + length)
        else:
            self.pieces.append((path, start, start + length))

    def add_chunk(self, path: Path, index: ChunkIndex, entries: Entries) -> None:
        """Add a chunk and the indexes of its messages, which are made again if they do not fit."""
        place, length = index.chunk_start_offset, index.chunk_length
        blobs = [_index_record(channel, places) for channel, places in entries.items()]
        made = b"".join(blobs)
        self.copy(path, place, length)
        with open(path, "rb") as file:
            file.seek(place + length)
            fits = file.read(len(made)) == made
        if fits:
            self.copy(path, place + length, len(made))
        else:
            self.pieces.append(made)
        index.chunk_start_offset, index.message_index_length = self.found.end, len(made)
        end = self.found.end + length
        for channel, blob in zip(entries, blobs, strict=True):
            index.message_index_offsets[channel] = end
            end += len(blob)
        self.found.add_chunk(index, {channel: len(places) for channel, places in entries.items()})


Entries = dict[int, list[tuple[int, int]]]  # log time and offset in the chunk, by channel


def join(parts: Sequence[LogPart]) -> Joined:
    """The intact records of the parts of one log, in order.

    Raises:
        RendezviewError: a part cannot be read, or is not an MCAP file.
    """
    joined = Joined()
    for number, part in enumerate(parts):
        _add_part(joined, part, first=number == 0)
    return joined


def _add_part(joined: Joined, part: LogPart, first: bool) -> None:
    expected = len(MAGIC)  # offset of the next record if nothing is damaged
    damaged = 0
    for record, offset, length in records(part.path, part.size):
        damaged += offset - expected
        expected = offset + length
        if isinstance(record, Chunk):
            entries = _entries(record)
            if entries is None:
                damaged += length
            else:
                joined.add_chunk(part.path, chunk_index(record, offset, length), entries)
        elif isinstance(record, DataEnd):
            joined.damaged_bytes += damaged
            return
        elif not isinstance(record, MessageIndex) and (first or not _known(record, joined.found)):
            joined.copy(part.path, offset, length)
            joined.found.add(record, joined.found.end, length)
    joined.damaged_bytes += damaged
    size = part.path.stat().st_size if part.size is None else part.size
    joined.cut_bytes += max(0, size - expected)


def _known(record: McapRecord, found: Scan) -> bool:
    """Whether the first part of a log has this record already."""
    if isinstance(record, Schema):
        return record.id in found.schemas
    if isinstance(record, Channel):
        return record.id in found.channels
    if isinstance(record, Attachment):
        return any(
            (index.name, index.data_size) == (record.name, len(record.data))
            for index in found.attachments
        )
    return isinstance(record, Header)


def _entries(chunk: Chunk) -> Entries | None:
    """The index entries of a chunk's messages; None if it is damaged."""
    data = content_of(chunk)
    if data is None:
        return None
    entries: Entries = {}
    place = 0
    while place + _MESSAGE.size <= len(data):
        opcode, length, channel, _, log_ns = _MESSAGE.unpack_from(data, place)
        if opcode == Opcode.MESSAGE:
            entries.setdefault(channel, []).append((log_ns, place))
        place += _HEAD_BYTES + length
    return entries if place == len(data) else None


def _index_record(channel: int, entries: list[tuple[int, int]]) -> bytes:
    builder = RecordBuilder()
    MessageIndex(channel, entries).write(builder)
    return taken(builder)


@dataclass(frozen=True, slots=True)
class Mended:
    """A log that was repaired."""

    path: Path  # the whole log: the old name, or a new one beside a damaged file
    cut_bytes: int  # of a last frame that was not complete
    damaged_bytes: int  # left out in the middle


def mend(path: Path) -> Mended | None:
    """Repair a log that was cut off or damaged; None if it is whole, or repaired already.

    The repaired log is a new file. Where only an incomplete end was left out, it takes the place
    of the old one; where something in the middle is damaged, the old one stays beside it.

    Raises:
        RendezviewError: not an MCAP file, it is being written, or the copy cannot be written.
    """
    copy = path.with_name(f"{path.stem}{RECOVERED}{path.suffix}")
    with locked(path):
        if copy.exists():
            return None
        joined = join([LogPart(path)])
        place = copy if joined.damaged_bytes else path
        with reading(path):  # a fault of writing is explained by `atomic_write`
            if is_finished(path) and not joined.damaged_bytes:
                return None
            with atomic_write(place) as file:
                for block in joined.blocks():
                    file.write(block)
    return Mended(place, joined.cut_bytes, joined.damaged_bytes)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a log, so that no service writes it or removes it.

    Raises:
        RendezviewError: a service writes it, or it cannot be opened.
    """
    with reading(path):
        file = os.open(path, os.O_RDONLY)
    try:
        try:
            ours = lock(file)
        except OSError as error:
            raise RendezviewError(
                f"{path}: its file system has no locks ({error.strerror}), so a service may be "
                "writing it: copy it to another disk first"
            ) from error
        if not ours:
            raise RendezviewError(f"{path}: is being written: close its session first")
        yield
    finally:
        os.close(file)
