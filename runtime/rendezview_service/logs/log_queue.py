"""What a log keeps in memory: entries that wait for the disk, or that no fsync has confirmed."""

from __future__ import annotations

import time
import zlib
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from itertools import islice

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, ChunkIndex, MessageIndex
from mcap.records import Message as McapMessage

from rendezview_service.logs import log_schemas
from rendezview_service.logs.log_index import Scan, chunk_index, taken

MOST_AT_ONCE = 512  # entries in one write; the system takes 1024. Source: a chosen limit


@dataclass(slots=True, eq=False)
class Entry:
    """A chunk of a log with its indexes, which fits any place of any part."""

    content: bytes
    index: ChunkIndex  # its offsets count from the start of `content`
    counts: Counter[int]  # messages by channel
    states: int  # states, or lines of other sensors
    put_s: float  # monotonic, when it came
    end: int = 0  # where it ends in the part that has it; 0: none has
    recorded: bool = False  # it has been

    @classmethod
    def of(
        cls, log_s: float, parts: list[log_schemas.Logged], compression: str, states: int
    ) -> Entry:
        """An entry of messages that were received at a time."""
        log_ns = log_schemas.nanoseconds(log_s)
        body = RecordBuilder()
        places: dict[int, list[tuple[int, int]]] = {}
        for channel, data, time_ns, sequence in parts:
            places.setdefault(channel, []).append((log_ns, body.count))
            McapMessage(channel, log_ns, data, time_ns, sequence).write(body)
        whole = taken(body)
        chunk = Chunk(
            compression=compression,
            data=_compressed(whole, compression),
            message_start_time=log_ns,
            message_end_time=log_ns,
            uncompressed_crc=zlib.crc32(whole),
            uncompressed_size=len(whole),
        )
        out = RecordBuilder()
        chunk.write(out)
        index = chunk_index(chunk, 0, out.count)
        for channel, entries in places.items():
            index.message_index_offsets[channel] = out.count
            MessageIndex(channel, entries).write(out)
        index.message_index_length = out.count - index.chunk_length
        counts = Counter(channel for channel, *_ in parts)
        return cls(taken(out), index, counts, states, time.monotonic())

    def add_to(self, found: Scan) -> None:
        """Add it to the index of the part that has it now."""
        offsets = self.index.message_index_offsets
        placed = {channel: found.end + place for channel, place in offsets.items()}
        index = replace(self.index, chunk_start_offset=found.end, message_index_offsets=placed)
        found.add_chunk(index, self.counts)
        self.end = found.end


@dataclass(slots=True)
class Kept:
    """Entries in order: those that are in the present part, then those that wait."""

    most_bytes: int
    _entries: deque[Entry] = field(default_factory=deque)
    _written: int = 0  # of them in the part
    _bytes: int = 0

    @property
    def oldest(self) -> Entry | None:
        """The first one that waits."""
        return self._entries[self._written] if len(self._entries) > self._written else None

    @property
    def waiting(self) -> list[Entry]:
        """The first ones that wait."""
        return [*islice(self._entries, self._written, self._written + MOST_AT_ONCE)]

    @property
    def waiting_states(self) -> int:
        """Number of states and lines in all that wait."""
        return sum(entry.states for entry in islice(self._entries, self._written, None))

    def add(self, entry: Entry) -> bool:
        """Take an entry; False: there is no room. What is in the part makes room first."""
        while self._entries and self._bytes + len(entry.content) > self.most_bytes:
            if not self._written:
                return False
            self._forget()
        self._entries.append(entry)
        self._bytes += len(entry.content)
        return True

    def written(self, count: int) -> None:
        """So many more are in the part."""
        for entry in islice(self._entries, self._written, self._written + count):
            entry.recorded = True
        self._written += count

    def confirmed(self, end: int) -> None:
        """What ends up to there in the part need not be kept."""
        while self._written and self._entries[0].end <= end:
            self._forget()

    def put_back(self) -> int:
        """Nothing is in a part any more: all wait. The number of states that were."""
        put_back, now_s = 0, time.monotonic()
        for entry in self._entries:
            put_back += entry.states if entry.end else 0
            entry.end, entry.put_s = 0, now_s
        self._written = 0
        return put_back

    def _forget(self) -> None:
        self._bytes -= len(self._entries.popleft().content)
        self._written -= 1


def _compressed(content: bytes, how: str) -> bytes:
    if how == "lz4":
        return bytes(lz4.frame.compress(content))
    return zstandard.compress(content, 1) if how == "zstd" else content
