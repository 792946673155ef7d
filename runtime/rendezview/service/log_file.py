"""MCAP logs that were cut off: find the complete part and append the index.

A log has one chunk per frame, written before the frame is acknowledged. After a kill the file has
no index, and its last record may be incomplete. `scan` finds the last complete chunk; `mend`
removes what follows and appends the index that readers expect.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk

from rendezview.errors import RendezviewError
from rendezview.io.files import StrPath, write_error

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, length
_PARSED: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
_MOST_RECORD = 4_000_000_000  # bytes; a longer record is damage. Source: a chosen limit


@dataclass(slots=True, eq=False)
class ChunkIndexes:
    """Chunk indexes in their written form: one per frame, about 130 bytes each."""

    written: bytearray = field(default_factory=bytearray)
    count: int = 0
    start_ns: int = 0
    end_ns: int = 0

    def add(self, index: ChunkIndex) -> None:
        """Add the index of a chunk."""
        self.written += _written([index])
        first = self.count == 0
        self.start_ns = (
            index.message_start_time if first else min(self.start_ns, index.message_start_time)
        )
        self.end_ns = max(self.end_ns, index.message_end_time)
        self.count += 1


@dataclass(slots=True, eq=False)
class Scan:
    """The complete part of a log."""

    end: int = len(MAGIC)  # offset after the last complete record of data
    finished: bool = False  # it has its index and its end
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: ChunkIndexes = field(default_factory=ChunkIndexes)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)  # messages by channel

    def add(self, record: McapRecord, offset: int, length: int) -> None:
        """Count a record of the data section, other than chunks and their indexes."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Metadata):
            self.metadata.append(MetadataIndex(offset=offset, length=length, name=record.name))
        elif isinstance(record, Attachment):
            index = AttachmentIndex(
                offset=offset,
                length=length,
                log_time=record.log_time,
                create_time=record.create_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            )
            self.attachments.append(index)
        self.end = offset + length


def records(path: StrPath, most: int | None = None) -> Iterator[tuple[McapRecord, int, int]]:
    """Complete records of data with offset and length, up to damage or the index.

    Args:
        most: number of bytes to read; None: all.

    Raises:
        RendezviewError: the file cannot be read, or is not an MCAP file.
    """
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            size = size if most is None else min(size, most)
            if file.read(len(MAGIC)) != MAGIC:
                raise RendezviewError(f"{path}: not an MCAP log: name another file")
            place = len(MAGIC)
            while place + _HEAD.size <= size:
                opcode, length = _HEAD.unpack(file.read(_HEAD.size))
                end = place + _HEAD.size + length
                if length > _MOST_RECORD or end > size:
                    return
                body = file.read(length)
                record = _parsed(opcode, body)
                if record is None:
                    return
                yield record, place, end - place
                if isinstance(record, DataEnd):
                    return
                place = end
    except FileNotFoundError:
        raise RendezviewError(f"{path}: no such log: check the path") from None
    except OSError as error:
        raise RendezviewError(f"{path}: cannot be read ({error.strerror})") from error


def _parsed(opcode: int, body: bytes) -> McapRecord | None:
    """A record of data; None for damage. Records that are not needed stay empty."""
    if opcode == Opcode.DATA_END:
        return DataEnd(0)
    kind = _PARSED.get(opcode)
    if kind is None:
        return McapRecord()
    try:
        record: McapRecord = kind.read(ReadDataStream(io.BytesIO(body)))
    except (McapError, ValueError, struct.error):
        return None
    if isinstance(record, Attachment):
        stored = struct.unpack("<I", body[-4:])[0]
        if stored and stored != zlib.crc32(memoryview(body)[:-4]):
            return None
    return record


def messages(chunk: Chunk) -> list[Message] | None:
    """The messages of a chunk; None if it is damaged."""
    try:
        parts = breakup_chunk(chunk, validate_crc=True)
    except (McapError, ValueError, struct.error, RuntimeError, EOFError, MemoryError):
        return None
    return [part for part in parts if isinstance(part, Message)]


def scan(path: StrPath, most: int | None = None) -> Scan:
    """The complete part of a log: up to the last chunk with all its indexes.

    Raises:
        RendezviewError: the file cannot be read, or is not an MCAP file.
    """
    found = Scan()
    chunk: ChunkIndex | None = None
    missing: set[int] = set()  # channels of the chunk whose index is still to come
    inside: Counter[int] = Counter()
    for record, offset, length in records(path, most):
        if isinstance(record, MessageIndex) and chunk is not None:
            chunk.message_index_offsets[record.channel_id] = offset
            chunk.message_index_length += length
            missing.discard(record.channel_id)
            if not missing:
                found.chunks.add(chunk)
                found.counts += inside
                found.end, chunk = offset + length, None
            continue
        if chunk is not None:
            break  # its indexes are missing
        if isinstance(record, Chunk):
            parts = messages(record)
            if parts is None:
                break
            chunk = chunk_index(record, offset, length)
            inside = Counter(part.channel_id for part in parts)
            missing = set(inside)
        elif isinstance(record, DataEnd):
            found.finished = _has_ending(path)
            break
        else:
            found.add(record, offset, length)
    return found


def chunk_index(chunk: Chunk, offset: int, length: int) -> ChunkIndex:
    """The index of a chunk, without the indexes of its messages."""
    return ChunkIndex(
        message_start_time=chunk.message_start_time,
        message_end_time=chunk.message_end_time,
        chunk_start_offset=offset,
        chunk_length=length,
        message_index_offsets={},
        message_index_length=0,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        uncompressed_size=chunk.uncompressed_size,
    )


def ending(found: Scan) -> bytes:
    """The end of a finished log (summary and index), to be written at ``found.end``."""
    head = _written([DataEnd(0)])
    start = found.end + len(head)
    groups: list[tuple[Opcode, bytes | bytearray]] = [
        (Opcode.SCHEMA, _written(found.schemas.values())),
        (Opcode.CHANNEL, _written(found.channels.values())),
        (Opcode.STATISTICS, _written([_statistics(found)])),
        (Opcode.CHUNK_INDEX, found.chunks.written),
        (Opcode.ATTACHMENT_INDEX, _written(found.attachments)),
        (Opcode.METADATA_INDEX, _written(found.metadata)),
    ]
    summary, offsets = bytearray(), []
    for opcode, group in groups:
        if group:
            offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
        summary += group
    offsets_start = start + len(summary)
    summary += _written(offsets)
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start)
    checksum = zlib.crc32(footer, zlib.crc32(summary))
    return head + summary + _written([Footer(start, offsets_start, checksum)]) + MAGIC


def mend(path: StrPath) -> int | None:
    """Repair a log that was cut off, in place; the bytes removed, or None if it is complete.

    Raises:
        RendezviewError: not an MCAP file, or it cannot be written.
    """
    found = scan(path)
    if found.finished:
        return None
    try:
        with open(path, "r+b") as file:
            cut = os.fstat(file.fileno()).st_size - found.end
            file.truncate(found.end)
            file.seek(found.end)
            file.write(ending(found))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise write_error(Path(path), error) from error
    return cut


def taken(builder: RecordBuilder) -> bytes:
    """The bytes of a builder, which is empty afterwards."""
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _written(records: Iterable[Any]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return taken(builder)


def _statistics(found: Scan) -> Statistics:
    return Statistics(
        attachment_count=len(found.attachments),
        channel_count=len(found.channels),
        channel_message_counts=dict(found.counts),
        chunk_count=found.chunks.count,
        message_count=sum(found.counts.values()),
        message_start_time=found.chunks.start_ns,
        message_end_time=found.chunks.end_ns,
        metadata_count=len(found.metadata),
        schema_count=len(found.schemas),
    )


def _has_ending(path: StrPath) -> bool:
    with open(path, "rb") as file:
        file.seek(-len(MAGIC), os.SEEK_END)
        return file.read() == MAGIC
