"""Reading MCAP logs, whole, cut off or damaged.

A log has one chunk per frame, written before the frame counts as recorded. After a kill it has
no index, and its last record may be incomplete. A damaged record is passed over: reading goes on
with the next chunk.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream

from rendezview.errors import RendezviewError
from rendezview.io.files import StrPath
from rendezview.io.sequences.mcap_messages import MOST_RECORD
from rendezview_service.logs.log_index import MAGIC, Scan

WRITER = "rendezview"  # in the header of the service's own logs
SESSION_METADATA, MODEL_ATTACHMENT = "rendezview.session", "model.rvm"
_HEAD = struct.Struct("<BQ")  # opcode, length
_PARSED: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
# Codes of other records, of this or a later version of MCAP. Source: mcap.dev/spec, "Opcodes".
_OTHER = (Opcode.MESSAGE, *range(0x0B, 0x0F), *range(0x80, 0x100))
_WINDOW = 1 << 20  # bytes that are searched at once for the next chunk. Source: chosen
# The start of a chunk: opcode, a length below 4 GiB, times, size and checksum, a compression.
# Source: mcap.dev/spec, "Chunk".
_CHUNK = re.compile(  # one may begin inside another's head, where that is none
    rb"(?=\x06(.{4}\0{4}).{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)(.{8}))", re.DOTALL
)
_CHUNK_START = 57  # bytes that the pattern may need. Source: its own length
_MOST_EXTRA = 1024  # bytes in a record, of fields of later versions. Source: a chosen limit


@dataclass(frozen=True, slots=True, eq=False)
class LogHead:
    """What a log says before its messages."""

    notes: dict[str, str]  # metadata of the session; empty in files of other programs
    model: bytes | None
    kinds: dict[int, str]  # the name of each channel's schema


def head_of(path: StrPath, *, with_model: bool = False) -> LogHead:
    """The head of a log; its model only if that is wanted, which is long.

    Raises:
        RendezviewError: it is missing or not an MCAP file.
    """
    found, notes, model = Scan(), dict[str, str](), None
    for record, offset, length in records(path):
        found.add(record, offset, length)
        if isinstance(record, Metadata) and record.name == SESSION_METADATA:
            notes = dict(record.metadata)
        elif isinstance(record, Attachment) and record.name == MODEL_ATTACHMENT:
            model = record.data
        if isinstance(record, Chunk) or (notes and not with_model):
            break
    return LogHead(notes, model, found.kinds)


def records(path: StrPath, most: int | None = None) -> Iterator[tuple[McapRecord, int, int]]:
    """Complete records of data with offset and length, up to the end or the index.

    Damaged records are left out, so that the offsets have gaps.

    Args:
        most: number of bytes to read; None: all.

    Raises:
        RendezviewError: the file cannot be read, or is not an MCAP file.
    """
    with reading(path), open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        size = size if most is None else min(size, most)
        if file.read(len(MAGIC)) != MAGIC:
            raise RendezviewError(f"{path}: not an MCAP log: name another file")
        place: int | None = len(MAGIC)
        while place is not None and place + _HEAD.size <= size:
            found = _record_at(file, place, size)
            if found is None:
                place = next_chunk(file, place + 1, size)
                continue
            record, length = found
            yield record, place, length
            if isinstance(record, DataEnd):
                return
            place += length


@contextlib.contextmanager
def reading(path: StrPath) -> Iterator[None]:
    """Explain why a log cannot be read.

    Raises:
        RendezviewError: it is missing, or its disk fails.
    """
    try:
        yield
    except FileNotFoundError:
        raise RendezviewError(f"{path}: no such log: check the path") from None
    except OSError as error:
        raise RendezviewError(f"{path}: cannot be read ({error.strerror})") from error


def record_at(path: StrPath, place: int) -> McapRecord | None:
    """The record at an offset; None for damage.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        found = _record_at(file, place, os.fstat(file.fileno()).st_size)
    return None if found is None else found[0]


def _record_at(file: BinaryIO, place: int, size: int) -> tuple[McapRecord, int] | None:
    """The record at an offset and its length; None for damage."""
    file.seek(place)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(head)
    end = place + _HEAD.size + length
    if length > MOST_RECORD or end > size:
        return None
    record = _parsed(opcode, file.read(length))
    return None if record is None else (record, end - place)


def next_chunk(file: BinaryIO, place: int, size: int) -> int | None:
    """The offset of the next chunk that its checksum confirms; what only looks like one is not."""
    while place < size:
        file.seek(place)
        window = file.read(min(_WINDOW + _CHUNK_START, size - place))
        for match in _CHUNK.finditer(window):
            whole, inside = (int.from_bytes(length, "little") for length in match.groups())
            head = match.end(2) - match.start() - _HEAD.size
            if match.start() >= _WINDOW or whole != head + inside:
                continue
            found = _record_at(file, place + match.start(), size)
            if found is not None and isinstance(found[0], Chunk) and _is_confirmed(found[0]):
                return place + match.start()
        place += _WINDOW
    return None


def _is_confirmed(chunk: Chunk) -> bool:
    """Whether its checksum fits; where its writer left that out, whether its records do."""
    data = content_of(chunk)
    if data is None or chunk.uncompressed_crc:
        return data is not None
    place = 0
    while place + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, place)
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            return False
        place += _HEAD.size + length
    return place == len(data) > 0


def _parsed(opcode: int, body: bytes) -> McapRecord | None:
    """A record of data; None for damage. Records that are not needed stay empty."""
    if opcode == Opcode.DATA_END:
        return DataEnd(0) if len(body) == 4 else None
    kind = _PARSED.get(opcode)
    if kind is None:
        return McapRecord() if opcode in _OTHER else None
    content = io.BytesIO(body)
    try:
        record: McapRecord = kind.read(ReadDataStream(content))
    except (McapError, ValueError, struct.error, MemoryError, OverflowError):
        return None
    extra = len(body) - content.tell()
    if extra > (0 if isinstance(record, Chunk | MessageIndex) else _MOST_EXTRA):
        return None  # its length was damaged
    if isinstance(record, Attachment):
        stored = struct.unpack("<I", body[-4:])[0]
        if stored and stored != zlib.crc32(memoryview(body)[:-4]):
            return None
    return record


_DAMAGE = (McapError, ValueError, struct.error, RuntimeError, EOFError, MemoryError)


def content_of(chunk: Chunk) -> bytes | None:
    """The unpacked content of a chunk; None if it is damaged."""
    try:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(length) if length == chunk.uncompressed_size else None
    except _DAMAGE:
        return None


def messages(chunk: Chunk) -> list[Message] | None:
    """The messages of a chunk; None if it is damaged."""
    try:
        parts = breakup_chunk(chunk, validate_crc=True)
    except _DAMAGE:
        return None
    return [part for part in parts if isinstance(part, Message)]


def is_own(path: StrPath) -> bool:
    """Whether the service wrote this file; False for logs of other programs, and no logs."""
    try:
        with open(path, "rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return False
            found = _record_at(file, len(MAGIC), os.fstat(file.fileno()).st_size)
    except OSError:
        return False
    return found is not None and isinstance(found[0], Header) and found[0].library == WRITER


def own_notes(path: Path) -> dict[str, str]:
    """The metadata of one of the service's own logs; those of files as they were are remembered.

    Raises:
        RendezviewError: it is another file.
        OSError: it cannot be read.
    """
    status = path.stat()
    return _own_notes(path, status.st_ino, status.st_mtime_ns)


@lru_cache(maxsize=4096)
def _own_notes(path: Path, *_: int) -> dict[str, str]:
    if not is_own(path):
        raise RendezviewError(f"{path}: no log of the service: name another file")
    return head_of(path).notes


def is_finished(path: StrPath) -> bool:
    """Whether a log has its end.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        if file.seek(0, os.SEEK_END) < 2 * len(MAGIC):
            return False
        file.seek(-len(MAGIC), os.SEEK_END)
        return file.read() == MAGIC
