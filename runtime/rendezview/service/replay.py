"""Logs read again: their frames, and a run repeated bit for bit."""

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
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.records import Message as McapMessage
from pydantic import ValidationError
from pydantic_core import to_json

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance import ViewModel
from rendezview.service.frames import read_frame
from rendezview.service.fusion_messages import LoggedMeasurement
from rendezview.service.log_file import messages, records
from rendezview.service.messages import SessionRequest
from rendezview.service.recording import MODEL_ATTACHMENT, SESSION_METADATA
from rendezview.service.tracking import Follower, StateDict, camera_of

# What a run repeats; times of stages and of the clock are of the day.
REPEATED = (
    "frame", "time_s", "phase", "status", "reason", "pose", "covariance", "confidence", "score",
    "range_m", "rates", "candidates", "fit", "on_nodes", "fused",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class LoggedFrame:
    """A frame of a log: what went in and what came out."""

    time_s: float
    image: bytes | None  # as it was sent
    state: dict[str, Any] | None


Word = LoggedFrame | LoggedMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A log of ours, cut off or not, or another MCAP file with Foxglove images."""

    path: Path
    notes: dict[str, str]  # of the session
    model: bytes | None

    @property
    def request(self) -> SessionRequest | None:
        """The session as it was asked for; None in files of others."""
        try:
            text = self.notes.get("request")
            return None if text is None else SessionRequest.model_validate_json(text)
        except ValidationError:
            raise RendezviewError(
                f"{self.path}: what it says of its session cannot be read: another version's log"
            ) from None

    @property
    def camera(self) -> Camera | None:
        """The camera of the session."""
        request = self.request
        return None if request is None or request.camera is None else camera_of(request.camera)

    def frames(self) -> Iterator[LoggedFrame]:
        """In order; up to where the file is whole."""
        return (word for word in self.words() if isinstance(word, LoggedFrame))

    def words(self) -> Iterator[Word]:
        """Frames, and the lines of other sensors, in the order in which they were taken."""
        kinds: dict[int, str] = {}
        encodings: dict[int, str] = {}
        schemas: dict[int, str] = {}
        for record, _, _ in records(self.path):
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                kinds[record.id] = schemas.get(record.schema_id, "")
                encodings[record.id] = record.message_encoding
            elif isinstance(record, Chunk):
                parts = messages(record) or []
                yield from _lines(self.path, parts, kinds)
                yield from _frames(self.path, parts, kinds)


def read_log(path: Path) -> Log:
    """The beginning of a log.

    Raises:
        RendezviewError: missing, or no MCAP file.
    """
    notes: dict[str, str] = {}
    model = None
    for record, _, _ in records(path):
        if isinstance(record, Metadata) and record.name == SESSION_METADATA:
            notes = dict(record.metadata)
        elif isinstance(record, Attachment) and record.name == MODEL_ATTACHMENT:
            model = record.data
        elif isinstance(record, Chunk):
            break
    return Log(path, notes, model)


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
                    f"{path}: a sensor's line cannot be read: another version's log"
                ) from None


def _frames(path: Path, parts: list[McapMessage], kinds: dict[int, str]) -> Iterator[LoggedFrame]:
    """The frames in the messages of one chunk; those of one time belong together."""
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
class Repeated:
    """How a repetition went."""

    frames: int = 0
    poses: int = 0
    lines: int = 0  # of other sensors
    first_difference: str | None = None
    differing: int = 0
    largest: float = 0.0  # difference of two numbers that should be one
    gap: str | None = None  # why the comparison ended early


def model_of(log: Log, model: Path | None) -> ViewModel:
    """The model a log was made with: given, or the log's own.

    Raises:
        RendezviewError: neither.
    """
    if model is not None:
        return ViewModel.load(model)
    if log.model is None:
        raise RendezviewError(
            f"{log.path}: holds no model (target {log.notes.get('target', '?')}, file "
            f"{log.notes.get('model_file', '?')}): give it by --model"
        )
    with tempfile.NamedTemporaryFile(suffix=".rvm") as file:
        file.write(log.model)
        file.flush()
        return ViewModel.load(file.name)


def repeat(log: Log, model: ViewModel) -> Iterator[tuple[StateDict, Repeated]]:
    """Track the frames of a log again and compare with what it says, number by number.

    Raises:
        RendezviewError: the log has no images, or is not one of ours.
    """
    request = log.request
    if request is None:
        raise RendezviewError(f"{log.path}: says nothing of a session: use it as a --source")
    forgotten = log.notes.get("forgotten") == "yes"
    follower = Follower(log.notes.get("session", "replay"), model, request, forgotten=forgotten)
    so_far = Repeated()
    expected = 0
    lines = 0
    for word in log.words():
        if isinstance(word, LoggedMeasurement):
            if word.order != lines:
                so_far.gap = (
                    f"lines {lines} to {word.order - 1} of other sensors are not in the log: "
                    "compared up to there"
                )
                return
            lines += 1
            _measure_again(follower, word, so_far)
            continue
        frame = word
        if frame.state is None:
            continue
        if frame.image is None:
            raise RendezviewError(f"{log.path}: was recorded without images: nothing to repeat")
        if frame.state["frame"] != expected:
            so_far.gap = (
                f"frames {expected} to {frame.state['frame'] - 1} are not in the log (the tracker "
                "remembers them): compared up to there"
            )
            return
        expected += 1
        image = read_frame(frame.image, follower.camera)
        state, _ = follower.look(image, frame.time_s, frame.state["received_unix_s"])
        again = json.loads(to_json(state, inf_nan_mode="null"))
        so_far.frames += 1
        so_far.poses += state["pose"] is not None
        _compare(again, frame.state, REPEATED, f"frame {state['frame']}", so_far)
        yield state, so_far


def _measure_again(follower: Follower, word: LoggedMeasurement, so_far: Repeated) -> None:
    """One line of another sensor through the filter, beside what the log says of it."""
    text = json.dumps(word.record).encode()
    (line,) = follower.filter.check(word.sensor, text, follower.last_s, math.inf)
    verdict, fused = follower.filter.take(word.sensor, line)
    so_far.lines += 1
    again = json.loads(to_json({"verdict": verdict, "fused": fused}, inf_nan_mode="null"))
    said = word.model_dump(mode="json")
    where = f"line {word.order} of the other sensors"
    _compare(again, said, ("verdict", "fused"), where, so_far)


def _compare(
    again: dict[str, Any], said: dict[str, Any], names: tuple[str, ...], where: str,
    so_far: Repeated,
) -> None:  # fmt: skip
    different = [name for name in names if again.get(name) != said.get(name)]
    if not different:
        return
    so_far.differing += 1
    for name in different:
        so_far.largest = max(so_far.largest, apart(again.get(name), said.get(name)))
    if so_far.first_difference is None:
        so_far.first_difference = f"{where}: {', '.join(different)}"


def apart(a: Any, b: Any) -> float:
    """The largest difference of numbers in two like JSON values; infinite if they are unlike."""
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return max((apart(a[key], b[key]) for key in a), default=0.0)
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return max((apart(x, y) for x, y in zip(a, b, strict=True)), default=0.0)
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b)
    return 0.0 if a == b else math.inf
