"""The logs of the service's folder, to look back at: their states, pictures and contours.

A log is read by single chunks, whose places are found by their heads. The files' own pictures go to
the browser as they are; nothing is decoded here but raw grey levels, which cannot be malformed.
"""

from __future__ import annotations

import contextlib
import struct
import threading
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.opcode import Opcode
from mcap.records import Chunk

from rendezview.errors import RendezviewError
from rendezview.sensors.appearance import ViewModel
from rendezview_service.logs.log_file import head_of, messages, next_chunk, own_notes, record_at
from rendezview_service.logs.log_folder import parts_from, parts_in
from rendezview_service.logs.log_index import MAGIC
from rendezview_service.logs.log_repair import RECOVERED
from rendezview_service.logs.replay import Log, LoggedFrame, frames_of, model_of, read_log
from rendezview_service.messages.frames import FrameKind, kind_of
from rendezview_service.messages.messages import Contour, SessionRequest
from rendezview_service.messages.model_messages import Recorded
from rendezview_service.tracker.model_geometry import geometry
from rendezview_service.tracker.tracking import contour_shown, shown_pose

_HEAD = struct.Struct("<BQ")  # opcode, length
_TIMES = struct.Struct("<QQ")  # first and last time of a chunk, ns
_OPEN = 4  # logs whose places are remembered. Source: chosen
_JPEG_QUALITY = 85  # 0 … 100, of raw frames. Source: chosen


class Recording:
    """One log with its parts."""

    def __init__(self, path: Path) -> None:
        """A log that is not read yet.

        Raises:
            RendezviewError: it is not a log of a session.
        """
        self.path = path
        self.log: Log = read_log(path)
        self._frames: dict[int, tuple[Path, int]] = {}  # chunk of each frame that was listed
        self._kinds: dict[Path, dict[int, str]] = {}  # schema by channel
        self._lock = threading.Lock()

    @cached_property
    def request(self) -> SessionRequest:
        """The session's request.

        Raises:
            RendezviewError: the log is not one of the service.
        """
        request = self.log.request
        if request is None or request.camera is None:
            raise RendezviewError(f"{self.path.name}: has no session in it")
        return request

    @cached_property
    def model(self) -> ViewModel:
        """Its model. RendezviewError: the log has none."""
        return model_of(self.log, None)

    @cached_property
    def geometry_json(self) -> bytes:
        """Its `Geometry`."""
        return geometry(self.model.name, self.model).model_dump_json().encode()

    def history(self, most: int) -> dict[str, Any]:
        """A `History` of evenly chosen frames, without events."""
        with self._lock:
            places = places_of(self.log.parts)
            step = max(1, -(-len(places) // most))
            states = []
            for path, offset, _ in places[::step]:
                for frame in self._read(path, offset):
                    if frame.state is not None:
                        number = int(frame.state["frame"])
                        self._frames[number] = path, offset
                        states.append(frame.state)
        numbers = [int(state["frame"]) for state in states]
        return {
            "session": self.log.notes.get("session", self.path.stem),
            "oldest_frame": min(numbers, default=None),
            "newest_frame": max(numbers, default=None),
            "images": numbers if states else [],
            "states": states,
        }

    def frame(self, number: int) -> LoggedFrame | None:
        """A frame that `history` listed, or the last one before it."""
        with self._lock:
            known = [frame for frame in self._frames if frame <= number]
            if not known:
                return None
            path, offset = self._frames[max(known)]
            found = [f for f in self._read(path, offset) if f.state is not None]
        return found[-1] if found else None

    def picture(self, number: int) -> tuple[int, bytes, str] | None:
        """Frame, content and media type of a picture; None if there is none."""
        frame = self.frame(number)
        if frame is None or frame.image is None or frame.state is None:
            return None
        kind, shown = kind_of(frame.image), int(frame.state["frame"])
        if kind is not FrameKind.RAW:
            return shown, frame.image, f"image/{kind}"
        camera = self.request.camera
        assert camera is not None
        levels = np.frombuffer(frame.image, np.uint8)
        if levels.size != camera.width * camera.height:
            return None
        image = levels.reshape(camera.height, camera.width)
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        return shown, bytes(cv2.imencode(".jpg", image, options)[1]), "image/jpeg"

    def contour(self, number: int) -> Contour | None:
        """Contour points at the pose of a frame; None without one."""
        frame = self.frame(number)
        if frame is None or frame.state is None or shown_pose(frame.state)[0] is None:
            return None  # whether the log has a model or not
        return contour_shown(self.model, self.log.camera, frame.state)

    def _read(self, path: Path, offset: int) -> list[LoggedFrame]:
        if path not in self._kinds:
            self._kinds[path] = head_of(path).kinds
        chunk = record_at(path, offset)
        parts = messages(chunk) if isinstance(chunk, Chunk) else None
        return list(frames_of(path, parts or [], self._kinds[path]))


class Recordings:
    """All logs of a folder; the last few that were looked at stay open."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._opened = lru_cache(_OPEN)(lambda path, _size: Recording(path))

    def list(self) -> list[Recorded]:
        """The first parts of all logs, the newest first."""
        if self._folder is None:
            return []
        found, known = [], parts_in(self._folder)
        for path in self._folder.glob("*.mcap"):
            # Another program's, one that is being removed, or of a damaged head.
            with contextlib.suppress(RendezviewError, OSError, ValueError, LookupError):
                notes = own_notes(path)
                if notes.get("part", "1") == "1":
                    found.append(summary(path, notes, parts_from(path, notes, known)))
        return sorted(found, key=lambda one: (-(one.began_unix_s or 0.0), one.name))

    def get(self, name: str) -> Recording | None:
        """A log by its name; None if there is none."""
        path = None if self._folder is None else self._folder / name
        if path is None or path.name != name or path.suffix != ".mcap" or not path.is_file():
            return None
        return self._opened(path, path.stat().st_size)


def summary(path: Path, notes: dict[str, str], parts: list[Path]) -> Recorded:
    """A log of such notes as the list has it.

    Raises:
        OSError: it cannot be read.
    """
    extents = [_extent(part, part.stat().st_size) for part in parts]
    counts, times = [e[0] for e in extents], [t for e in extents if e[0] for t in e[1:]]
    request = SessionRequest.model_validate_json(notes["request"])
    assert request.camera is not None
    return Recorded(
        name=path.name,
        session=notes.get("session", path.stem),
        model=notes.get("target", "?"),
        model_sha256=notes.get("model_sha256", ""),
        camera=request.camera.model_dump(),
        opened_unix_s=float(notes["opened_unix_s"]) if "opened_unix_s" in notes else None,
        began_unix_s=min(times) * 1e-9 if times else None,
        length_s=(max(times) - min(times)) * 1e-9 if times else None,
        frames=sum(counts) or None,
        size_bytes=sum(part.stat().st_size for part in parts),
        parts=len(parts),
        recovered=RECOVERED in path.stem,
    )


@lru_cache(maxsize=1024)
def _extent(path: Path, size: int) -> tuple[int, int, int]:
    """Number of chunks of a file of a size, and the times (ns) of the first and the last."""
    times = [at for _, _, at in places_of([path])]
    return len(times), min(times, default=0), max(times, default=0)


def places_of(parts: list[Path]) -> list[tuple[Path, int, int]]:
    """File, offset and time (ns) of each chunk, by the heads of records."""
    found = []
    for path in parts:
        size = path.stat().st_size
        with open(path, "rb") as file:
            place: int | None = len(MAGIC)
            while place is not None and place + _HEAD.size <= size:
                file.seek(place)
                opcode, length = _HEAD.unpack(file.read(_HEAD.size))
                end = place + _HEAD.size + length
                if opcode == Opcode.DATA_END:
                    break
                if opcode == 0 or end > size:  # damage
                    place = next_chunk(file, place + 1, size)
                    continue
                if opcode == Opcode.CHUNK:
                    first_ns, _ = _TIMES.unpack(file.read(_TIMES.size))
                    found.append((path, place, first_ns))
                place = end
    return found
