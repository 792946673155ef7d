"""Gives the frames of a source to a session."""

from __future__ import annotations

import asyncio
import threading
import time

from rendezview.errors import RendezviewError
from rendezview_service.hub.inputs import SOURCE
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.sources import Source, SourceFrame

# s, between frames of a file; longer gaps are shortened. Source: a chosen limit.
_LONGEST_PAUSE_S = 10.0


class Feeder:
    """A thread that gives the frames of a source to a session."""

    def __init__(
        self, source: Source, session: Session, loop: asyncio.AbstractEventLoop, speed: float
    ) -> None:
        """Files play at ``speed`` times their own rate; 0: without pauses."""
        self._source, self._session, self._loop, self._speed = source, session, loop, speed
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._source.close()

    def _run(self) -> None:
        reason: str | None = None
        try:
            last_s: float | None = None
            due_s = time.monotonic()
            for frame in self._source.frames(self._stop):
                if self._stop.is_set():
                    break
                if isinstance(frame, RendezviewError):
                    self._loop.call_soon_threadsafe(self._session.note_fault, str(frame))
                    continue
                if not self._source.live and self._speed > 0.0:
                    if last_s is not None and frame.time_s is not None:
                        pause_s = (frame.time_s - last_s) / self._speed
                        due_s = max(due_s + min(max(pause_s, 0.0), _LONGEST_PAUSE_S), 0.0)
                    last_s = frame.time_s
                    if self._stop.wait(max(0.0, due_s - time.monotonic())):
                        break
                self._give(frame)
        except RendezviewError as error:
            reason = str(error)
        except RuntimeError:
            return  # the loop is closed: the service has ended
        if not self._stop.is_set():
            self._loop.call_soon_threadsafe(self._session.source_ended, reason)

    def _give(self, frame: SourceFrame) -> None:
        done = threading.Event()
        waiting = self._session.input(
            [frame.content], frame.time_s, lambda answer: done.set(), sender=SOURCE
        )
        self._loop.call_soon_threadsafe(self._session.replace, waiting)
        while not (self._source.live or self._stop.is_set() or done.is_set()):
            done.wait(0.5)
