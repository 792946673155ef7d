"""Reads logs: their frames, and a run repeated bit for bit."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from mcap.records import Chunk, Metadata
from mcap.records import Message as McapMessage
from pydantic import ValidationError
from pydantic_core import to_json

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance import ViewModel
from rendezview_service.logs.log_file import (
    SESSION_METADATA,
    head_of,
    messages,
    records,
)
from rendezview_service.logs.log_folder import parts_from
from rendezview_service.logs.log_index import Scan
from rendezview_service.messages.frames import read_frame
from rendezview_service.messages.fusion_messages import LoggedMeasurement
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.tracker.tracking import SessionTracker, StateDict, camera_of

# Keys of a state that a repetition must reproduce; computing and clock times differ.
REPEATED = (
    "frame", "time_s", "phase", "status", "reason", "pose", "covariance", "confidence", "score",
    "range_m", "rates", "candidates", "fit", "on_nodes", "fused", "motion", "approach",
    "ring", "reflectors", "trajectory",
)  # fmt: skip
_LATER = ("motion", "approach", "ring", "reflectors", "trajectory")  # not in older logs


@dataclass(frozen=True, slots=True, eq=False)
class LoggedFrame:
    """A frame of a log and its state."""

    time_s: float
    image: bytes | None  # as it was sent
    state: dict[str, Any] | None


@dataclass(frozen=True, slots=True, eq=False)
class LoggedStart:
    """The beginning of a part of a log, with its metadata."""

    notes: dict[str, str]

    @property
    def continues(self) -> bool:
        """Whether the tracker of the part before it goes on."""
        return self.notes.get("continues") == "yes"


LogEntry = LoggedStart | LoggedFrame | LoggedMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A log of the service, complete or cut off, or another MCAP file with Foxglove images.

    Damage is passed over.
    """

    path: Path
    notes: dict[str, str]  # metadata of the session; empty in files of other programs
    model: bytes | None
    parts: list[Path]  # its files

    @property
    def request(self) -> SessionRequest | None:
        """The session's request; None in files of other programs."""
        return self.request_of(self.notes)

    def request_of(self, notes: dict[str, str]) -> SessionRequest | None:
        """The session's request at the start of a part; None in files of other programs."""
        try:
            text = notes.get("request")
            return None if text is None else SessionRequest.model_validate_json(text)
        except ValidationError:
            raise RendezviewError(
                f"{self.path}: its session's request cannot be read: another version wrote this log"
            ) from None

    @property
    def camera(self) -> Camera | None:
        """The camera of the session."""
        request = self.request
        return None if request is None or request.camera is None else camera_of(request.camera)

    def frames(self) -> Iterator[LoggedFrame]:
        """The frames in order."""
        return (entry for entry in self.entries() if isinstance(entry, LoggedFrame))

    def entries(self) -> Iterator[LogEntry]:
        """Frames and lines of other sensors, in the order in which the worker took them."""
        begun = False
        for path in self.parts:
            for entry in _entries(path):
                first = isinstance(entry, LoggedStart) and not begun
                begun = begun or first
                yield LoggedStart(self.notes) if first else entry


def _entries(path: Path) -> Iterator[LogEntry]:
    found = Scan()
    for record, offset, length in records(path):
        found.add(record, offset, length)
        if isinstance(record, Metadata) and record.name == SESSION_METADATA:
            yield LoggedStart(dict(record.metadata))
        elif isinstance(record, Chunk):
            parts = messages(record) or []
            yield from _lines(path, parts, found.kinds)
            yield from frames_of(path, parts, found.kinds)


def read_log(path: Path) -> Log:
    """Open a log with the parts that follow it in its folder, and read its metadata.

    Raises:
        RendezviewError: it is missing or not an MCAP file.
    """
    head = head_of(path, with_model=True)
    return Log(path, head.notes, head.model, parts_from(path, head.notes))


def _lines(
    path: Path, parts: list[McapMessage], kinds: dict[int, str]
) -> Iterator[LoggedMeasurement]:
    """The lines of other sensors in the messages of one chunk."""
    for part in parts:
        if kinds.get(part.channel_id) == "rendezview.Measurement":
            try:
                yield LoggedMeasurement.model_validate_json(part.data)
            except ValidationError:
                raise RendezviewError(
                    f"{path}: a sensor's line cannot be read: another version wrote this log"
                ) from None


def frames_of(path: Path, parts: list[McapMessage], kinds: dict[int, str]) -> Iterator[LoggedFrame]:
    """The frames in the messages of one chunk; messages of one time belong to one frame."""
    waiting: dict[tuple[int, int], dict[str, Any]] = {}
    for part in parts:
        kind = kinds.get(part.channel_id, "")
        entry = waiting.setdefault((part.publish_time, part.sequence), {})
        try:
            if kind == "rendezview.State":
                entry["state"] = json.loads(part.data)
            elif kind == "foxglove.RawImage":
                raw = RawImage.FromString(part.data)
                if raw.encoding in ("mono8", "8UC1") and raw.step == raw.width:
                    entry["image"] = raw.data
            elif kind == "foxglove.CompressedImage":
                entry["image"] = CompressedImage.FromString(part.data).data
        except (ValueError, DecodeError) as error:
            raise RendezviewError(f"{path}: a message cannot be read ({error})") from None
    for (published, _), entry in waiting.items():
        if not entry:
            continue
        state = entry.get("state")
        time_s = float(state["time_s"]) if state is not None else published * 1e-9
        yield LoggedFrame(time_s, entry.get("image"), state)


@dataclass(slots=True)
class Comparison:
    """How a repetition compares with its log."""

    frames: int = 0
    poses: int = 0
    lines: int = 0  # of other sensors
    first_difference: str | None = None
    differing: int = 0
    largest: float = 0.0  # difference of two numbers that should be equal
    gap: str | None = None  # frames that could not be compared, and why

    def add_gap(self, missing: str) -> None:
        """Note frames or lines that are not in the log."""
        self.gap = self.gap or (
            f"{missing} are not in the log (the tracker remembers them): compared up to there, and "
            "from the next tracker on"
        )


def model_of(log: Log, model: Path | None) -> ViewModel:
    """The model of a log: the given one, else the one in the log.

    Raises:
        RendezviewError: there is neither.
    """
    if model is not None:
        return ViewModel.load(model)
    if log.model is None:
        raise RendezviewError(
            f"{log.path}: has no model (target {log.notes.get('target', '?')}, file "
            f"{log.notes.get('model_file', '?')}): give it by --model"
        )
    with tempfile.NamedTemporaryFile(suffix=".rvm") as file:
        file.write(log.model)
        file.flush()
        return ViewModel.load(file.name)


def repeat(log: Log, model: ViewModel) -> Iterator[tuple[StateDict, Comparison]]:
    """Track the frames of a log again and compare the states, number by number.

    Raises:
        RendezviewError: the log has no images, or is not one of the service.
    """
    if log.request is None:
        raise RendezviewError(f"{log.path}: has no session in it: use the file as a --source")
    so_far = Comparison()
    run: _Run | None = None  # None: frames are missing; the next tracker is compared again
    for entry in log.entries():
        if isinstance(entry, LoggedStart):
            if not entry.continues:
                run = _Run.of(log, entry.notes, model)
            continue
        if run is None:
            if so_far.gap is None:
                raise RendezviewError(
                    f"{log.path}: begins in the middle of a run: the tracker remembers frames of "
                    "earlier parts, which are not here: it can be read, but not repeated"
                )
            continue
        if isinstance(entry, LoggedMeasurement):
            if entry.order != run.lines:
                so_far.add_gap(f"lines {run.lines} to {entry.order - 1} of other sensors")
                run = None
                continue
            run.lines += 1
            _measure_again(run.tracker, entry, so_far)
            continue
        if entry.state is None:
            continue
        if entry.image is None:
            raise RendezviewError(f"{log.path}: was recorded without images: it cannot be repeated")
        if entry.state["frame"] < run.expected:
            continue  # twice: an earlier part could not be cut back when its disk failed
        if entry.state["frame"] != run.expected:
            so_far.add_gap(f"frames {run.expected} to {entry.state['frame'] - 1}")
            run = None
            continue
        run.expected += 1
        image, logged = read_frame(entry.image, run.tracker.camera), entry.state
        about = logged["received_unix_s"], logged.get("drops", 0), logged.get("roi")
        state, _ = run.tracker.track(image, entry.time_s, *about)
        state["frame"] += run.first_frame
        again = json.loads(to_json(state, inf_nan_mode="null"))
        so_far.frames += 1
        so_far.poses += state["pose"] is not None
        names = tuple(name for name in REPEATED if name in entry.state or name not in _LATER)
        _compare(again, entry.state, names, f"frame {state['frame']}", so_far)
        yield state, so_far


@dataclass(slots=True)
class _Run:
    """One tracker, from its first frame on."""

    tracker: SessionTracker
    first_frame: int
    expected: int  # number of the next frame
    lines: int = 0

    @classmethod
    def of(cls, log: Log, notes: dict[str, str], model: ViewModel) -> _Run:
        request = log.request_of(notes)
        assert request is not None
        first = int(notes.get("first_frame", 0))
        name = notes.get("session", "replay")
        return cls(SessionTracker(name, model, request, notes), first, first)


def _measure_again(tracker: SessionTracker, line: LoggedMeasurement, so_far: Comparison) -> None:
    """Give a line of another sensor to the filter and compare with the log."""
    text = json.dumps(line.record).encode()
    (checked,) = tracker.filter.check(line.sensor, text, tracker.last_s, math.inf)
    verdict, fused = tracker.filter.take(line.sensor, checked)
    so_far.lines += 1
    again = json.loads(to_json({"verdict": verdict, "fused": fused}, inf_nan_mode="null"))
    logged = line.model_dump(mode="json")
    where = f"line {line.order} of the other sensors"
    _compare(again, logged, ("verdict", "fused"), where, so_far)


def _compare(
    again: dict[str, Any], logged: dict[str, Any], names: tuple[str, ...], where: str,
    so_far: Comparison,
) -> None:  # fmt: skip
    different = [name for name in names if again.get(name) != logged.get(name)]
    if not different:
        return
    so_far.differing += 1
    for name in different:
        so_far.largest = max(so_far.largest, difference(again.get(name), logged.get(name)))
    if so_far.first_difference is None:
        so_far.first_difference = f"{where}: {', '.join(different)}"


def difference(a: Any, b: Any) -> float:
    """The largest difference of numbers in two JSON values; infinite if they differ in form."""
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return max((difference(a[key], b[key]) for key in a), default=0.0)
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return max((difference(x, y) for x, y in zip(a, b, strict=True)), default=0.0)
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b)
    return 0.0 if a == b else math.inf
