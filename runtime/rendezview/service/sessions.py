"""Sessions as the service sees them: frames that wait, what came of them, who watches."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic_core import to_json

from rendezview.service.frames import Bytes
from rendezview.service.fusing import CAMERA
from rendezview.service.history import Past
from rendezview.service.messages import (
    Phase,
    Recording,
    RecordingState,
    SensorHealth,
    SessionInfo,
    SessionRequest,
)
from rendezview.service.metrics import Metrics
from rendezview.service.pool import Worker
from rendezview.service.sensors import Allowance, Arrivals, OtherSensors
from rendezview.service.settings import Settings
from rendezview.service.wire import Header

log = logging.getLogger("rendezview.service")

_STALE_S = 3.0  # a sensor without frames that long is not healthy


@dataclass(slots=True, eq=False)
class Answer:
    """What came of a frame or a sensor's lines, or the reason why nothing did."""

    status: int  # as in HTTP
    body: bytes  # of a `State`, or `Measured`
    error: str = ""


@dataclass(slots=True, eq=False)
class Waiting:
    """A frame that is to be looked at, or lines of another sensor."""

    pieces: Sequence[Bytes]  # its bytes, as they came
    time_s: float
    received_unix_s: float
    received_s: float  # monotonic
    answer: Callable[[Answer], None]
    sensor: str | None = None  # whose lines these are; None: a frame
    waited_s: float = 0.0  # since something came into the session before

    @property
    def length(self) -> int:
        """Bytes in all."""
        return sum(map(len, self.pieces))


@dataclass(slots=True, eq=False)
class Watcher:
    """One who sees the newest state, at most so often."""

    rate_hz: float
    width: int  # of pictures; 0: none
    contour: bool
    silhouette: bool
    news: asyncio.Event = field(default_factory=asyncio.Event)
    message: tuple[bytes, bytes] | None = None  # the newest: text, and picture or nothing
    due_s: float = 0.0
    ended: str | None = None

    def show(self, text: bytes, picture: bytes) -> None:
        """Replace what it has not read yet."""
        self.message = text, picture
        self.news.set()

    def end(self, reason: str) -> None:
        """Nothing more will come."""
        self.ended = reason
        self.news.set()


class Full(Exception):
    """No room: too many frames wait, or too many sessions there are."""


class Session:
    """One camera and one target."""

    def __init__(
        self,
        name: str,
        model: str,
        request: SessionRequest,
        settings: Settings,
        metrics: Metrics,
        source: str | None = None,
    ) -> None:
        self.id = name
        self.model = model
        self.request = request
        self.settings = settings
        self.source = source
        self.worker: Worker | None = None
        self.created_unix_s = time.time()
        self.log_path: str | None = None
        self.recording = Recording(state=RecordingState.OFF)
        self.past = Past(settings.history_s, settings.history_rate_hz, settings.history_image_hz)
        self.last: bytes | None = None  # the last state, JSON
        self.last_header: Header = {}
        self.watchers: set[Watcher] = set()
        self.finished = False
        self.reason: str | None = None
        self.used_s = time.monotonic()
        self._metrics = metrics.of_session(name)
        self._queue: deque[Waiting] = deque()  # of plain requests
        self._newest: Waiting | None = None  # of streams and sources
        self._due: set[Watcher] = set()  # who will see the frame that is looked at
        self._frame_base = 0  # frames before the worker was started anew
        self._frames = 0
        self._found = 0
        self._drops = 0
        self._last_pose_s: float | None = None
        self._phase = Phase.WAITING
        self._arrivals = Arrivals()
        self._others = OtherSensors()
        self._allowance = Allowance(settings.measurements_per_s)
        self._last_fault: str | None = None

    # Frames in

    def queue(self, waiting: Waiting) -> None:
        """A frame that is to be looked at after those before it.

        Raises:
            Full: too many wait.
        """
        if self._count(frames=True) >= self.settings.waiting:
            raise Full
        self._arrived(waiting)
        self._queue.append(waiting)
        self._wake()

    def measure(self, waiting: Waiting) -> None:
        """Lines of another sensor; none is dropped.

        Raises:
            Full: too many wait, or too many come a second.
        """
        too_fast = self._allowance.is_spent(waiting.received_s)
        if too_fast or self._count(frames=False) >= self.settings.measurements_waiting:
            raise Full
        waiting.waited_s = max(0.0, waiting.received_s - self.used_s)
        self.used_s = waiting.received_s
        self._queue.append(waiting)
        self._wake()

    def replace(self, waiting: Waiting) -> None:
        """A frame of a stream: the one that waited is dropped."""
        if self._newest is not None:
            self._drops += 1
            self._metrics.drops.inc()
            self._newest.answer(Answer(0, b""))
        self._arrived(waiting)
        self._newest = waiting
        self._wake()

    @property
    def is_fused(self) -> bool:
        """Whether another sensor has said something."""
        return self._others.is_fused

    @property
    def has_waiting(self) -> bool:
        """Whether a frame is waiting."""
        return bool(self._queue) or self._newest is not None

    def take(self) -> Waiting | None:
        """The frame that came first of those waiting."""
        newest = self._newest
        if newest is not None and (
            not self._queue or newest.received_s <= self._queue[0].received_s
        ):
            self._newest = None
            return newest
        return self._queue.popleft() if self._queue else None

    def header_of(self, waiting: Waiting) -> Header:
        """What the worker is told of a frame, or of a sensor's lines."""
        about: Header = {
            "session": self.id,
            "length": waiting.length,
            "received_unix_s": waiting.received_unix_s,
            "first_frame": self._frame_base,
        }
        if waiting.sensor is not None:
            return about | {
                "kind": "measure",
                "sensor": waiting.sensor,
                "waited_s": waiting.waited_s,
                "most_lines": self.settings.measurement_lines,
            }
        now_s = time.monotonic()
        self._due = {w for w in self.watchers if w.due_s <= now_s}
        wants = self.past.wants_image(now_s)
        width = max((w.width for w in self._due), default=0)
        if wants:
            width = max(width, self.settings.history_image_px)
        extras: Header | None = None
        if self._due or wants:
            extras = {
                "contour": any(w.contour for w in self._due),
                "silhouette": any(w.silhouette for w in self._due),
                "width": width,
            }
        return about | {
            "kind": "frame",
            "time_s": waiting.time_s,
            "received_s": waiting.received_s,
            "drops": self._drops,
            "extras": extras,
        }

    def most_lines_of(self, waiting: Waiting) -> int:
        """How many lines a sensor's message can hold."""
        breaks = sum(bytes(piece).count(b"\n") for piece in waiting.pieces)
        return min(1 + breaks, self.settings.measurement_lines)

    def _count(self, frames: bool) -> int:
        return sum((waiting.sensor is None) is frames for waiting in self._queue)

    def _arrived(self, waiting: Waiting) -> None:
        self.used_s = waiting.received_s
        self._arrivals.add(waiting.received_s, waiting.received_unix_s)

    def _wake(self) -> None:
        if self.worker is not None:
            self.worker.wake(self)

    # What came of them

    def saw(self, waiting: Waiting, header: Header, state: bytes) -> None:
        """A state of the worker."""
        self._frames += 1
        self.last, self.last_header = state, header
        self._last_fault = None
        phase = Phase(header["phase"])
        if phase is Phase.TRACKING:
            self._found += 1
            self._last_pose_s = header["time_s"]
        if phase is not self._phase:
            log.info(
                "phase", extra={"session": self.id, "phase": str(phase), "frame": header["frame"]}
            )
            self._phase = phase
        if "recording" in header:
            self._recorded(header)
        self._others.told(header)
        now_s = time.monotonic()
        self._metrics.saw(header["status"], header["track_ms"], now_s - waiting.received_s)
        waiting.answer(Answer(200, state))
        self.past.add(now_s, header["frame"], state)

    def measured(self, waiting: Waiting, header: Header, answer: bytes) -> None:
        """The worker has taken lines of a sensor."""
        assert waiting.sensor is not None
        self._allowance.spend(header["lines"])
        self._others.heard(waiting.sensor, waiting.received_s, waiting.received_unix_s, header)
        if "recording" in header:
            self._recorded(header)
        self._metrics.measured(waiting.sensor, header["lines"], header["accepted"])
        waiting.answer(Answer(200, answer))

    def saw_more(self, header: Header, picture: bytes) -> None:
        """The pictures and contours that go with the last state."""
        if self.last is None:
            return
        now_s = time.monotonic()
        marks = self._others.marks(now_s)
        if picture and self.past.wants_image(now_s):
            self.past.add_image(now_s, header["frame"], picture, marks)
        sensors, recording = to_json(self.sensors()), to_json(self.recording)
        contour, outlines = to_json(header["contour"]), to_json(header["silhouette_px"])
        # Who came meanwhile sees the next one: nothing was asked for in its name.
        for watcher in self._due & self.watchers:
            shown = picture if watcher.width else b""
            text = b"".join(
                (
                    b'{"type":"state","state":',
                    self.last,
                    b',"contour":',
                    contour if watcher.contour else b"null",
                    b',"silhouette_px":',
                    outlines if watcher.silhouette else b"null",
                    b',"image_follows":',
                    b"true" if shown else b"false",
                    b',"sensors":',
                    sensors,
                    b',"recording":',
                    recording,
                    b',"marks":',
                    marks,
                    b"}",
                )
            )
            stamped = int(header["frame"]).to_bytes(8, "little") + shown if shown else b""
            watcher.show(text, stamped)
            # Half a period of slack, so that frames a little early are not left out.
            watcher.due_s = max(
                watcher.due_s + 1.0 / watcher.rate_hz, now_s + 0.5 / watcher.rate_hz
            )

    def refused(self, waiting: Waiting, error: str, internal: bool = False) -> None:
        """The worker could not take a frame, or a sensor's lines."""
        if waiting.sensor is None:
            self._last_fault = error
            self._metrics.refused.inc()
        else:
            self._allowance.spend(1)
        waiting.answer(Answer(500 if internal else 422, b"", error))

    def broken(self, waiting: Waiting) -> None:
        """The worker ended over a frame, or a sensor's lines."""
        told = "the tracker's process ended; it is started anew"
        if waiting.sensor is None:
            self._last_fault = told
        waiting.answer(Answer(503, b"", told))

    def reopened(self) -> None:
        """Another worker goes on with it: tracker and filter have forgotten."""
        self._others.forget("its filter ended with the process; it begins anew")
        self._frame_base = self._frames
        for watcher in self.watchers:
            watcher.due_s = 0.0

    def note_fault(self, error: str) -> None:
        """A frame of the source could not be read."""
        self._last_fault = error
        self._metrics.refused.inc()

    def source_ended(self, reason: str | None) -> None:
        """The source has come to its end, or failed."""
        self.finished, self.reason = True, reason
        log.info("source", extra={"session": self.id, "state": "ended", "reason": reason})

    def end(self, reason: str) -> None:
        """Nothing more comes: let all go who wait."""
        for waiting in (*self._queue, *((self._newest,) if self._newest else ())):
            waiting.answer(Answer(410, b"", reason))
        self._queue.clear()
        self._newest = None
        for watcher in self.watchers:
            watcher.end(reason)
        self._metrics.remove()

    def _recorded(self, header: Header) -> None:
        now = Recording.model_validate(header["recording"])
        if now.state is not self.recording.state:
            level = logging.ERROR if now.state is RecordingState.FAILED else logging.INFO
            log.log(
                level,
                "recording",
                extra={"session": self.id, "state": str(now.state), "reason": now.reason},
            )
        self.recording = now
        self.log_path = header["log_path"]
        self._metrics.recording(now)

    # As it stands

    def sensors(self) -> list[SensorHealth]:
        """Health of what measures in this session."""
        now_s = time.monotonic()
        reason = None
        last_unix_s = self._arrivals.last_unix_s
        if last_unix_s is None:
            reason = "no frame yet"
        elif self.finished:
            reason = self.reason or "the source has come to its end"
        elif now_s - self._arrivals.times_s[-1] > _STALE_S:
            reason = f"no frame for {now_s - self._arrivals.times_s[-1]:.0f} s"
        elif self._last_fault is not None:
            reason = self._last_fault
        camera = SensorHealth(
            name=CAMERA,
            kind="camera",
            healthy=reason is None,
            reason=reason,
            frames=self._frames,
            drops=self._drops,
            rate_hz=self._arrivals.rate_hz(now_s),
            last_unix_s=last_unix_s,
            trust=self._others.trust_of(CAMERA),
        )
        return [camera, *self._others.health(now_s)]

    def info(self) -> SessionInfo:
        """The session as a message."""
        assert self.request.camera is not None
        last: dict[str, Any] = self.last_header
        time_s = last.get("time_s")
        return SessionInfo(
            id=self.id,
            model=self.model,
            camera=self.request.camera,
            source=self.source,
            phase=self._phase,
            created_unix_s=self.created_unix_s,
            frames=self._frames,
            drops=self._drops,
            found_fraction=self._found / self._frames if self._frames else None,
            watchers=len(self.watchers),
            last_frame=last.get("frame"),
            last_time_s=time_s,
            since_pose_s=None
            if self._last_pose_s is None or time_s is None
            else time_s - self._last_pose_s,
            sensors=self.sensors(),
            recording=self.recording,
            finished=self.finished,
            reason=self.reason,
        )
