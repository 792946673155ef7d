"""The index of an MCAP log: what its end lists, so that readers can seek."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from mcap.data_stream import RecordBuilder
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
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
# Records as far as they are needed. Source: mcap.dev/spec, "Records"
_FOOTER, _FOOTER_BYTES = struct.Struct("<BQQQ"), 29
_OFFSET, _OFFSET_HEAD = struct.Struct("<BQBQ"), 9
_STATISTICS = struct.Struct("<BQQHIIIIQQ")


@dataclass(slots=True, eq=False)
class Scan:
    """The complete part of a log."""

    end: int = len(MAGIC)  # offset after the last complete record of data
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: bytearray = field(default_factory=bytearray)  # written indexes, 130 bytes a frame
    chunk_count: int = 0
    start_ns: int = 0
    end_ns: int = 0
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

    def add_chunk(self, index: ChunkIndex, counts: Mapping[int, int]) -> None:
        """Add the index of a chunk at `end`, and its messages by channel."""
        self.chunks += _written([index])
        first_ns = index.message_start_time
        self.start_ns = min(self.start_ns, first_ns) if self.chunk_count else first_ns
        self.end_ns = max(self.end_ns, index.message_end_time)
        self.chunk_count += 1
        self.counts.update(counts)
        self.end += index.chunk_length + index.message_index_length

    @property
    def kinds(self) -> dict[int, str]:
        """The name of each channel's schema."""
        names = {number: schema.name for number, schema in self.schemas.items()}
        return {channel.id: names.get(channel.schema_id, "") for channel in self.channels.values()}


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
        (Opcode.CHUNK_INDEX, found.chunks),
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


def last_ns(file: BinaryIO) -> int | None:
    """The time of the last message of a finished log, by its statistics; None: it has none.

    Raises:
        OSError: it cannot be read.
    """
    try:
        end = file.seek(-len(MAGIC) - _FOOTER_BYTES, os.SEEK_END)
        place = _FOOTER.unpack(file.read(_FOOTER.size))[-1]
        while 0 < place < end:
            file.seek(place)
            opcode, length, group, start = _OFFSET.unpack(file.read(_OFFSET.size))
            if opcode != Opcode.SUMMARY_OFFSET:
                return None
            if group == Opcode.STATISTICS:
                file.seek(start)
                *_, last = _STATISTICS.unpack(file.read(_STATISTICS.size))
                return int(last) or None
            place += _OFFSET_HEAD + length
    except struct.error:
        pass
    return None


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
        chunk_count=found.chunk_count,
        message_count=sum(found.counts.values()),
        message_start_time=found.start_ns,
        message_end_time=found.end_ns,
        metadata_count=len(found.metadata),
        schema_count=len(found.schemas),
    )
