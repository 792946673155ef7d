"""A session as the service sees it: its queue, the answers of its worker, its watchers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial

from pydantic_core import to_json

from rendezview_service.hub import inputs
from rendezview_service.hub.checkpoint import Checkpoint, CheckpointKeeper
from rendezview_service.hub.clock import SessionClock
from rendezview_service.hub.history import Histories, Past
from rendezview_service.hub.inputs import Answer, InputQueue, SessionInput, TokenBucket
from rendezview_service.hub.metrics import Metrics
from rendezview_service.hub.model_store import StoredModel
from rendezview_service.hub.once import Once
from rendezview_service.hub.progress import Progress
from rendezview_service.hub.session_events import AttachedFlight, SessionEvents
from rendezview_service.hub.session_log import SessionLog
from rendezview_service.hub.watching import Watchers
from rendezview_service.messages.approach_messages import Level
from rendezview_service.messages.frames import Bytes, longest_frame
from rendezview_service.messages.messages import Recording, SensorHealth, SessionRequest
from rendezview_service.messages.wire import Header
from rendezview_service.settings import Settings
from rendezview_service.tracker.sensor_health import STALE_S, Arrivals, OtherSensors

_REMEMBERED = 64  # answers, for requests that are repeated. Source: a chosen limit


class Session:
    """One camera and one target."""

    def __init__(
        self,
        name: str,
        stored: StoredModel,
        request: SessionRequest,
        settings: Settings,
        metrics: Metrics,
        histories: Histories,
        source: str | None = None,
    ) -> None:
        """A session without a worker; frames wait until it has one.

        Args:
            stored: the model; it stays the same, whatever happens to its name.
            histories: of all sessions.
            source: a source that the service itself reads; None: clients send the frames.
        """
        self.id = name
        self.stored = stored
        self.model = stored.name
        self.request = request
        self.request_now = request  # of the present worker: its prior is the last pose
        self.handover: Header | None = None  # the `Fused` state that its filter goes on from
        self.bar = inputs.Bar()
        self.settings = settings
        assert request.camera is not None
        longest = longest_frame(request.camera.width, request.camera.height)
        self.frame_bytes = min(settings.frame_bytes, longest)
        self.source = source
        self.worker: inputs.Worker | None = None
        self.created_unix_s = time.time()
        self.log = SessionLog(name)
        rates_hz = settings.history_rate_hz, settings.history_image_hz
        self._histories = histories
        self.past = Past(settings.history_s, *rates_hz, self._histories)
        self._histories.enter(self.past)
        self.progress = Progress()
        self.watchers = Watchers(self._show_last)
        self.finished = False
        self.reason: str | None = None
        self.used_s = time.monotonic()
        self.once: Once[Answer] = Once(_REMEMBERED)
        self._last_key: str | None = None  # of the last frame's request
        self.clock = SessionClock.started_now()
        self.lease = inputs.Lease(settings.sender_hold_s if source is None else math.inf)
        if source is not None:
            self.lease.take(inputs.SOURCE, self.used_s)
        self._metrics = metrics
        metrics.begin(name)
        self.waiting = InputQueue()
        self.frame_base = 0  # number of frames before the present worker
        self.drops = 0
        self.events = SessionEvents(name, lambda: self.clock.now_unix_s)
        self.flight = AttachedFlight(self.events)
        for note in request.notes:
            self.events.add("session", Level.WARNING, note)
        self._arrivals = Arrivals()
        self._others = OtherSensors()
        self._lines = TokenBucket.full(settings.measurements_per_s, time.monotonic())
        self._last_fault: str | None = None
        self._refused_since_s: float | None = None  # no frame has been usable since
        self._was_fused = False
        self.keeper: CheckpointKeeper | None = None

    # Inputs

    def input(
        self,
        pieces: list[Bytes],
        time_s: float | None,
        answer: Callable[[Answer], None],
        *,
        sender: str = "",
        sensor: str | None = None,
        key: str | None = None,
        roi: list[float] | None = None,
    ) -> SessionInput:
        """An input that arrives now, by the session's clock.

        Args:
            time_s: of a frame; None: its arrival.

        Raises:
            RendezviewError: a client's frame is far ahead of the session's clock.
        """
        now_s = time.monotonic()
        if time_s is not None and self.source is None:
            self.progress.check_time(time_s)
        unix_s = self.clock.unix_s(now_s)
        at_s = unix_s if time_s is None else time_s
        return SessionInput(pieces, at_s, unix_s, now_s, answer, sensor, sender, key, roi)

    def queue(self, waiting: SessionInput) -> None:
        """A frame that is tracked after those before it.

        Raises:
            Full: too many wait.
            Taken: another sender has the session.
            Barred: one of its inputs ended a process.
        """
        self._admit(waiting)
        if self.waiting.count(frames=True) >= self.settings.waiting:
            raise inputs.Full
        self._arrived(waiting)
        self.waiting.append(waiting)
        self._wake()

    def measure(self, waiting: SessionInput) -> None:
        """Lines of another sensor; none is dropped.

        Raises:
            Full: too many wait, or too many come a second.
            Barred: as for frames.
        """
        self._admit(waiting)
        too_fast = self._lines.refill(waiting.received_s) < 0.0
        waiting_now = self.waiting.count(frames=False)
        if too_fast or waiting_now >= self.settings.measurements_waiting:
            raise inputs.Full
        waiting.waited_s = max(0.0, waiting.received_s - self.used_s)
        self.used_s = waiting.received_s
        self.waiting.append(waiting)
        self._wake()

    def replace(self, waiting: SessionInput) -> None:
        """A frame of a stream; it replaces the one that waits.

        Raises:
            Taken, Barred: as `queue`.
        """
        self._admit(waiting)
        self._arrived(waiting)
        dropped = self.waiting.replace(waiting)
        if dropped is not None:
            self.drops += 1
            self._metrics.dropped(self.id)
            dropped.answer(Answer(0, b""))
        self._wake()

    @property
    def idle_s(self) -> float:
        """Time without an input after which it ends."""
        asked = self.request.idle_s
        return self.settings.idle_s if asked is None else asked

    @property
    def is_fused(self) -> bool:
        """Whether another sensor has sent lines, here or at another service."""
        return self._was_fused or self._others.is_fused

    def header_of(self, waiting: SessionInput) -> Header:
        """The request to the worker for a frame or sensor lines."""
        about: Header = {
            "session": self.id,
            "length": waiting.length,
            "received_unix_s": waiting.received_unix_s,
            "first_frame": self.frame_base,
        }
        if waiting.sensor is not None:
            return about | {
                "kind": "measure",
                "sensor": waiting.sensor,
                "waited_s": waiting.waited_s,
            }
        now_s = time.monotonic()
        if waiting.shows_last:
            return about | {"kind": "show", "extras": self.watchers.missed_extras(now_s)}
        self.waiting.shows_last = None
        history_px = self.settings.history_image_px if self.past.wants_image(now_s) else 0
        return about | {
            "kind": "frame",
            "time_s": waiting.time_s,
            "received_s": waiting.received_s,
            "drops": self.drops,
            "roi": waiting.roi,
            "extras": self.watchers.extras(now_s, history_px),
        }

    def _admit(self, waiting: SessionInput) -> None:
        if self.source is None:
            self.bar.check()
        if waiting.sensor is None:
            self.lease.take(waiting.sender, waiting.received_s)

    def _arrived(self, waiting: SessionInput) -> None:
        self.used_s = waiting.received_s
        self._arrivals.add(waiting.received_s, waiting.received_unix_s)

    def _show_last(self) -> None:
        """Ask the worker for the last frame once more: watchers missed it."""
        self.waiting.shows_last = SessionInput([], 0.0, 0.0, 0.0, lambda _: None, shows_last=True)
        self._wake()

    def _wake(self) -> None:
        if self.worker is not None:
            self.worker.wake(self)

    # Answers of the worker

    def tracked(self, waiting: SessionInput, header: Header, state: bytes) -> None:
        """The state of a frame."""
        self.progress.add(header, state)
        self._last_key = waiting.key
        self._last_fault = None
        self._refused_since_s = None
        now_s = time.monotonic()
        self.events.phase(self.progress.phase, header["frame"], header["status"])
        self.events.limits(header.get("alarms", []), now_s)
        self.events.restarted(*header["starts"])
        self.events.fault(None)
        self.recorded(header)
        self._others.tracked(waiting.received_s, waiting.received_unix_s, header)
        latency_s = now_s - waiting.received_s
        self._metrics.tracked(self.id, header["status"], header["track_ms"], latency_s)
        answer = partial(waiting.answer, Answer(200, state))
        if self.keeper is None:
            answer()
        else:
            self.keeper.keep(self.checkpoint(), answer)
        self.past.add(now_s, header["frame"], state)
        self.watchers.tracked()

    def measured(self, waiting: SessionInput, header: Header, answer: bytes) -> None:
        """The answer to sensor lines."""
        assert waiting.sensor is not None
        self._lines.spend(header["lines"])
        self._others.received(waiting.sensor, waiting.received_s, waiting.received_unix_s, header)
        self.recorded(header)
        self._metrics.measured(self.id, waiting.sensor, header["lines"], header["accepted"])
        waiting.answer(Answer(200, answer))

    def add_extras(self, header: Header, picture: bytes) -> None:
        """The picture and contours of the last state, for the history and the watchers."""
        if self.progress.last is None:
            return
        now_s = time.monotonic()
        marks = self._others.marks(now_s)
        if picture and self.past.wants_image(now_s):
            self.past.add_image(now_s, header["frame"], picture, marks)
        sensors, recording = to_json(self.sensors()), to_json(self.log.recording)
        rest = b'"sensors":%b,"recording":%b,"marks":%b' % (sensors, recording, marks)
        self.watchers.show(now_s, self.progress.last, header, picture, rest)

    def recorded(self, header: Header) -> None:
        """How recording goes, if the session is recorded."""
        if "recording" in header:
            self.log.update(header["log_paths"], Recording.model_validate(header["recording"]))
            self.events.recording(self.log.recording)
            self._metrics.recording(self.id, self.log.recording)

    def refused(self, waiting: SessionInput, error: str, internal: bool = False) -> None:
        """The worker could not use a frame or sensor lines."""
        if waiting.shows_last:  # the worker has logged why
            return
        if waiting.sensor is None:
            self.watchers.wait()
            self._last_fault = error
            self._metrics.refused(self.id)
            self._refused_since_s = self._refused_since_s or time.monotonic()
            self.events.fault(error)
        else:
            self._lines.spend(1)
        waiting.answer(Answer(500 if internal else 422, b"", error))

    def lost(self, waiting: SessionInput, at_fault: bool) -> None:
        """The worker ended over a frame or sensor lines; perhaps these are at fault."""
        error = "the tracker's process ended over it: another one continues with the next frame"
        self.bar.ended(at_fault)
        self.events.add("worker", Level.ALARM, error)
        if waiting.sensor is None:
            self._last_fault = error
        waiting.answer(Answer(503, b"", error))

    def reopened(self) -> None:
        """Another worker continues the session, with a new tracker and filter.

        They start with the last pose and the last fused one, if these are not old.
        """
        if lost := self.log.moved():
            self.events.add("recording", Level.ALARM, f"{lost} states waited for the disk: lost")
        self.handover = self.progress.handover
        if self.progress.last_found is not None or self.handover is not None:
            prior, posterior = self.progress.prior
            known = {"prior": prior, "prior_posterior": posterior, "roi": None}
            self.request_now = self.request.model_copy(update=known)
        self._others.forget("its filter ended with the worker process; a new one starts")
        self.frame_base = self.progress.frames
        self.waiting.shows_last = None
        self.watchers.restart()

    def checkpoint(self) -> Checkpoint:
        """What another service needs to continue it."""
        return Checkpoint(
            request=self.request,
            model_sha256=self.stored.sha256,
            tracked=self.progress.model_copy(),  # another thread writes it
            log=self.log.id,
            log_base=self.log.base,
            log_paths=[part.path for part in self.log.parts],
            fused=self.is_fused,
            last_key=self._last_key,
        )

    def resume(self, kept: Checkpoint) -> None:
        """Continue a session of another service; the tracker starts at its last pose."""
        self._was_fused = kept.fused
        self.progress = kept.tracked
        if kept.last_key is not None and self.progress.last is not None:
            self.once.know(kept.last_key, Answer(200, self.progress.last))
        self.log.resume(kept.log, kept.log_base, kept.log_paths)
        self.events.add("node", Level.WARNING, "another process continues the session")
        self.reopened()

    # The source, and the end

    def note_fault(self, error: str) -> None:
        """A frame of the source could not be read."""
        self._last_fault = error
        self.events.fault(error)
        self._metrics.refused(self.id)

    def source_ended(self, reason: str | None) -> None:
        """The source has ended, or failed for a reason."""
        self.finished, self.reason = True, reason
        said = f"ended: {reason or f'no frames are left in {self.source}'}"
        self.events.add("source", Level.WARNING if reason else Level.INFO, said)

    def end(self, reason: str, status: int = 410) -> None:
        """Answer everything that waits, or comes later; nothing follows here."""
        self.waiting.close(Answer(status, b"", reason, ends=True))
        self._histories.leave(self.past)
        self.watchers.end(reason)
        self._metrics.end(self.id)
        self._metrics = Metrics()  # nobody's: what still comes is not counted

    # Information

    @property
    def blind_reason(self) -> str | None:
        """Why all frames of the last seconds were refused; None if they were not."""
        since_s, now_s = self._refused_since_s, time.monotonic()
        sent = self._arrivals.times_s and now_s - self._arrivals.times_s[-1] < STALE_S
        if since_s is None or now_s - since_s < STALE_S or not sent:
            return None
        return f"session {self.id}: every frame is refused for {now_s - since_s:.0f} s: " + (
            self._last_fault or "unknown"
        )

    def sensors(self) -> list[SensorHealth]:
        """Health of the camera and of the other sensors."""
        now_s = time.monotonic()
        ended = (self.reason or "the source has ended") if self.finished else None
        reason = self._arrivals.silence(now_s, self._last_fault) if ended is None else ended
        return self._others.health(now_s, self._arrivals, reason, self.progress.frames, self.drops)
