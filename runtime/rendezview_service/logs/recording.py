"""The log of a session: a state is in the file before it is acknowledged.

One write per frame holds a chunk and its indexes, so a kill at any moment loses no acknowledged
state. A log has several files, its parts, each complete in itself: a new one begins when the last
is large or old enough, when another worker continues the session, and after a fault. A full disk
does not stop the tracking: the file is cut to its last complete frame, the fault is reported, and
a new part is tried every few seconds. An open part is locked, so that nobody repairs or removes it.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Channel, Chunk, Header, MessageIndex, Metadata, Schema
from mcap.records import Message as McapMessage
from pydantic_core import to_json

from rendezview.geometry.camera import Camera
from rendezview.io.files import write_error
from rendezview_service.logs import log_schemas
from rendezview_service.logs.log_file import WRITER
from rendezview_service.logs.log_folder import SESSION_METADATA, free_number, part_path
from rendezview_service.logs.log_index import MAGIC, Scan, chunk_index, ending, taken
from rendezview_service.logs.log_lock import lock
from rendezview_service.messages.frames import Bytes, kind_of
from rendezview_service.messages.messages import Recording, RecordingState
from rendezview_service.tracker.tracking import StateDict

MODEL_ATTACHMENT = "model.rvm"
_CALIBRATION_EVERY_S = 1.0  # s, between messages with the camera. Source: chosen
_SYNC_EVERY_S = 1.0  # s, between fsyncs with `interval`. Source: chosen
_RETRY_S = 5.0  # s, before a new file is tried after a fault. Source: chosen


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """The parts to record, and when they are forced to the disk."""

    images: bool = True
    sync: Literal["always", "interval", "never"] = "interval"
    compression: Literal["", "lz4", "zstd"] = "lz4"
    part_bytes: int = 1_000_000_000  # of a part, then the next begins. Source: chosen
    part_s: float = 3600.0  # s, the same; bounds the index in memory to 15 MB. Source: chosen


class LogWriter:
    """Writes the log of one session. Disk faults are reported in `status`, not raised.

    One thread uses it: the worker's.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        metadata: Mapping[str, str],
        model: bytes | None,
        options: RecordingOptions | None = None,
    ) -> None:
        """Start a log, or its next part.

        Args:
            path: of its first part; if the file exists, the part gets the next number.
            metadata: the session's data for replay; ``log`` is common to the parts of a log.
            model: the model file, attached to each part.
        """
        self.options = options or RecordingOptions()
        self._base = path
        self._camera = camera
        self._metadata = {"log": secrets.token_hex(8)} | dict(metadata)
        self._part = 0
        self._begun_s = 0.0
        self._model = model
        self._file: int | None = None
        self._path = path
        self._scan = Scan()
        self._reason: str | None = None
        self._messages = 0  # of all parts of this writer
        self._earlier_bytes = 0  # of its parts before this one
        self._lost = 0
        self._unfinished: tuple[Path, Scan] | None = None  # a part without its end
        self._retry_at = 0.0
        self._calibrated_at = -1e300
        self._synced_at = 0.0
        self._syncing: threading.Thread | None = None
        self._open()

    @property
    def status(self) -> Recording:
        """State of the log."""
        return Recording(
            state=RecordingState.ON if self._reason is None else RecordingState.FAILED,
            reason=self._reason,
            name=self._path.name,
            messages=self._messages,
            size_bytes=self._scan.end,
            parts=self._part,
            all_bytes=self._earlier_bytes + (0 if self._file is None else self._scan.end),
            lost=self._lost,
        )

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._path

    def write(self, state: StateDict, state_json: bytes, content: Bytes) -> bool:
        """Append one frame; False if that failed (`status` has the reason)."""
        return self._keep(1, lambda: self._append_frame(state, state_json, content))

    def write_measurements(self, lines: list[dict[str, Any]]) -> bool:
        """Append lines of a sensor, all or none, each a `LoggedMeasurement`."""
        return self._keep(len(lines), lambda: self._append_measurements(lines))

    def _keep(self, count: int, append: Callable[[], None]) -> bool:
        if self._file is None and not self._try_again():
            self._lost += count
            return False
        try:
            if self._is_long:
                self.close(wait=False)
                self._open()
            if self._file is None:
                raise OSError(0, "no new part can be started")
            append()
        except OSError as error:
            if self._file is not None:
                self._fail(error)
            self._lost += count
            return False
        return True

    @property
    def _is_long(self) -> bool:
        """Whether the part is long enough, and has something in it."""
        old = time.monotonic() - self._begun_s > self.options.part_s
        return self._scan.chunks.count > 0 and (old or self._scan.end > self.options.part_bytes)

    def close(self, wait: bool = True) -> None:
        """Write the index. Closing again does nothing.

        Args:
            wait: until the file is on the disk.
        """
        if self._file is None:
            return
        file, self._file = self._file, None
        self._earlier_bytes += self._scan.end
        try:
            _write_all(file, ending(self._scan), self._scan.end)
            if wait:
                os.fsync(file)
        except OSError as error:
            self._reason = str(write_error(self._path, error))
            with contextlib.suppress(OSError):
                os.ftruncate(file, self._scan.end)
        if self._syncing is not None and wait:
            self._syncing.join()
        if wait or self.options.sync == "never":
            os.close(file)
        else:
            threading.Thread(target=_quiet_sync, args=(file,)).start()

    def _append_frame(self, state: StateDict, state_json: bytes, content: Bytes) -> None:
        log_ns = _ns(state["received_unix_s"])
        parts: list[tuple[int, bytes]] = [(log_schemas.STATE, state_json)]
        if state["pose"] is not None:
            parts.append((log_schemas.POSE, log_schemas.pose_bytes(state["time_s"], state["pose"])))
            transform = log_schemas.transform_bytes(state["time_s"], state["pose"])
            parts.append((log_schemas.TRANSFORM, transform))
        fused = state.get("fused")
        if fused is not None and fused["pose"] is not None:
            together = log_schemas.pose_bytes(state["time_s"], fused["pose"])
            parts.append((log_schemas.FUSED, together))
        if self.options.images:
            kind = kind_of(content)
            parts.append(log_schemas.image_bytes(state["time_s"], content, kind, self._camera))
        calibrates = state["received_unix_s"] - self._calibrated_at >= _CALIBRATION_EVERY_S
        if calibrates:
            calibration = log_schemas.calibration_bytes(state["time_s"], self._camera)
            parts.append((log_schemas.CALIBRATION, calibration))
        frame_ns, sequence = _ns(state["time_s"]), state["frame"] & 0xFFFFFFFF
        self._append(log_ns, [(channel, data, frame_ns, sequence) for channel, data in parts])
        if calibrates:
            self._calibrated_at = state["received_unix_s"]

    def _append_measurements(self, lines: list[dict[str, Any]]) -> None:
        log_ns = _ns(lines[0]["received_unix_s"])
        parts = []
        for line in lines:
            verdict, fused = line["verdict"], line["fused"]
            sequence = line["order"] & 0xFFFFFFFF
            time_ns = log_ns if verdict is None else _ns(verdict["time_s"])
            text = to_json(line, inf_nan_mode="null")
            parts.append((log_schemas.MEASUREMENT, text, time_ns, sequence))
            if fused is not None and fused["pose"] is not None:
                pose = log_schemas.pose_bytes(fused["time_s"], fused["pose"])
                parts.append((log_schemas.FUSED, pose, _ns(fused["time_s"]), sequence))
        self._append(log_ns, parts)

    def _append(self, log_ns: int, parts: list[tuple[int, bytes, int, int]]) -> None:
        """Append a chunk and its indexes; a part is (channel, data, time in ns, sequence)."""
        body = RecordBuilder()
        places: dict[int, list[tuple[int, int]]] = {}
        for channel, data, time_ns, sequence in parts:
            places.setdefault(channel, []).append((log_ns, body.count))
            McapMessage(channel, log_ns, data, time_ns, sequence).write(body)
        whole = taken(body)
        chunk = Chunk(
            compression=self.options.compression,
            data=_compressed(whole, self.options.compression),
            message_start_time=log_ns,
            message_end_time=log_ns,
            uncompressed_crc=zlib.crc32(whole),
            uncompressed_size=len(whole),
        )
        out = RecordBuilder()
        chunk.write(out)
        index = chunk_index(chunk, self._scan.end, out.count)
        for channel, entries in places.items():
            index.message_index_offsets[channel] = self._scan.end + out.count
            MessageIndex(channel, entries).write(out)
        index.message_index_length = out.count - index.chunk_length
        blob = taken(out)
        assert self._file is not None
        _write_all(self._file, blob, self._scan.end)
        self._sync()
        self._scan.end += len(blob)
        self._scan.chunks.add(index)
        self._scan.counts.update(channel for channel, *_ in parts)
        self._messages += len(parts)

    def _open(self) -> None:
        """Start a part. It gets its name when it has its beginning; a fault goes to ``_reason``."""
        first = self._part == 0
        number = free_number(self._base, self._part + 1)
        trial = self._base.with_name(f".{self._base.name}.{secrets.token_hex(4)}.tmp")
        self._path = part_path(self._base, number)
        file = None
        try:
            file = os.open(trial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            lock(file)
            notes = {"part": str(number), "continues": "no" if first else "yes"}
            _write_all(file, self._beginning(self._metadata | notes), 0)
            if self.options.sync == "always":
                os.fsync(file)
            while True:
                try:
                    os.link(trial, self._path)  # never over another service's file
                    break
                except FileExistsError:
                    number = free_number(self._base, number + 1)
                    self._path = part_path(self._base, number)
        except OSError as error:
            if file is not None:
                os.close(file)
            self._fail(error)
            return
        finally:
            with contextlib.suppress(OSError):
                trial.unlink()
        self._file, self._reason, self._part = file, None, number
        self._begun_s = time.monotonic()
        self._calibrated_at = -1e300

    def _beginning(self, notes: dict[str, str]) -> bytes:
        builder = RecordBuilder()
        Header("", WRITER).write(builder)
        found = Scan(end=len(MAGIC) + builder.count)

        def add(record: Schema | Channel | Metadata | Attachment) -> None:
            before = builder.count
            record.write(builder)
            found.add(record, len(MAGIC) + before, builder.count - before)

        for number, (topic, name, kind) in log_schemas.TOPICS.items():
            if kind is None:
                text = json.dumps(log_schemas.json_schema(number)).encode()
                add(Schema(id=number, data=text, encoding="jsonschema", name=name))
            else:
                data = log_schemas.descriptors(kind)
                add(Schema(id=number, data=data, encoding="protobuf", name=name))
            encoding = "json" if kind is None else "protobuf"
            add(
                Channel(
                    id=number,
                    topic=topic,
                    message_encoding=encoding,
                    metadata={},
                    schema_id=number,
                )
            )
        add(Metadata(name=SESSION_METADATA, metadata=notes))
        if self._model is not None and self.options.images:
            now = time.time_ns()
            add(
                Attachment(
                    create_time=now,
                    log_time=now,
                    name=MODEL_ATTACHMENT,
                    media_type="application/octet-stream",
                    data=self._model,
                )
            )
        self._scan = found
        return MAGIC + taken(builder)

    def _fail(self, error: OSError) -> None:
        self._reason = str(write_error(self._path, error))
        self._retry_at = time.monotonic() + _RETRY_S
        if self._file is None:
            return
        self._earlier_bytes += self._scan.end
        self._unfinished = (self._path, self._scan)
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, self._scan.end)
        os.close(self._file)
        self._file = None
        self._finish()

    def _finish(self) -> None:
        """Write the end of a part that broke off, if there is room for it."""
        if self._unfinished is None:
            return
        path, found = self._unfinished
        with contextlib.suppress(OSError):
            file = os.open(path, os.O_WRONLY)
            try:
                if lock(file):
                    _write_all(file, ending(found), found.end)
                    self._unfinished = None
            except OSError:
                os.ftruncate(file, found.end)
            finally:
                os.close(file)

    def _try_again(self) -> bool:
        if time.monotonic() < self._retry_at:
            return False
        self._open()
        if self._file is not None:
            self._finish()
        return self._file is not None

    def _sync(self) -> None:
        """Force the file to the disk: each time, or once a second in another thread."""
        if self.options.sync == "never" or self._file is None:
            return
        if self.options.sync == "always":
            os.fsync(self._file)
            return
        now = time.monotonic()
        busy = self._syncing is not None and self._syncing.is_alive()
        if now - self._synced_at < _SYNC_EVERY_S or busy:
            return
        self._synced_at = now
        self._syncing = threading.Thread(target=_quiet_sync, args=(os.dup(self._file),))
        self._syncing.start()


def _ns(time_s: float) -> int:
    return max(0, int(time_s * 1e9))


def _write_all(file: int, content: bytes, place: int) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(file, view, place)
        place += written
        view = view[written:]


def _quiet_sync(file: int) -> None:
    with contextlib.suppress(OSError):  # the next write reports it
        os.fsync(file)
    os.close(file)


def _compressed(content: bytes, how: str) -> bytes:
    if how == "lz4":
        return bytes(lz4.frame.compress(content))
    return zstandard.compress(content, 1) if how == "zstd" else content
