"""Watchers of a session: they see its newest state, each at its own rate."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import Any

from pydantic_core import to_json


@dataclass(slots=True, eq=False)
class Watcher:
    """One watcher, what it asked for, and the message that it has not read yet."""

    rate_hz: float
    width: int  # of pictures, px; 0: no pictures
    contour: bool
    silhouette: bool
    news: asyncio.Event = field(default_factory=asyncio.Event)
    message: tuple[bytes, bytes] | None = None  # text, and a picture or nothing
    due_s: float = 0.0  # monotonic time of its next message
    ended: str | None = None  # the reason

    @property
    def late_s(self) -> float:
        """When it sees a frame that it missed: a period late, so that a next one comes first."""
        return self.due_s + 1.0 / self.rate_hz

    async def messages(self) -> AsyncIterator[tuple[bytes, bytes]]:
        """The newest message whenever there is one, until it has ended."""
        while True:
            await self.news.wait()
            self.news.clear()
            if self.message is not None:
                newest, self.message = self.message, None
                yield newest
            if self.ended is not None:
                return

    def show(self, text: bytes, picture: bytes) -> None:
        """Replace the message that is not read yet."""
        self.message = text, picture
        self.news.set()

    def end(self, reason: str) -> None:
        """No message follows."""
        self.ended = reason
        self.news.set()


class Watchers(set[Watcher]):
    """All watchers of one session."""

    def __init__(self, show_last: Callable[[], None]) -> None:
        """No watchers yet.

        Args:
            show_last: called when watchers missed the last frame and no other came.
        """
        super().__init__()
        self._due: set[Watcher] = set()  # they will see the frame that is being tracked
        self._not_due: set[Watcher] = set()  # they will not, because they saw one just before
        self._missed: set[Watcher] = set()  # they have not seen the last frame
        self._show_last = show_last
        self._timer: asyncio.TimerHandle | None = None
        self._ended: str | None = None  # the reason

    def add(self, watcher: Watcher) -> None:
        """One more; the session may have ended while it came."""
        super().add(watcher)
        if self._ended is not None:
            watcher.end(self._ended)

    def extras(self, now_s: float, history_px: int) -> dict[str, Any] | None:
        """The parts that the worker adds to the next state, for due watchers and the history.

        Args:
            history_px: width of the history's picture; 0: the history needs none.
        """
        self._stop_waiting()
        self._due = {watcher for watcher in self if watcher.due_s <= now_s}
        self._not_due = set(self) - self._due
        if not self._due and not history_px:
            return None
        return self._wishes(history_px)

    def missed_extras(self, now_s: float) -> dict[str, Any]:
        """The parts of the last frame, for those who missed it and wait long enough."""
        self._due = {watcher for watcher in self._missed & self if watcher.late_s <= now_s}
        self._missed -= self._due
        return self._wishes(0)

    def tracked(self) -> None:
        """The frame has its state: who is not due misses it."""
        self._missed = self._not_due
        self.wait()

    def wait(self) -> None:
        """Those who missed the last frame see it late, unless another comes before."""
        self._stop_waiting()
        late_s = min((watcher.late_s for watcher in self._missed & self), default=None)
        if late_s is not None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(max(0.0, late_s - time.monotonic()), self._show_last)

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _wishes(self, history_px: int) -> dict[str, Any]:
        return {
            "contour": any(watcher.contour for watcher in self._due),
            "silhouette": any(watcher.silhouette for watcher in self._due),
            "width": max((history_px, *(watcher.width for watcher in self._due))),
        }

    def show(
        self, now_s: float, state: bytes, extras: dict[str, Any], picture: bytes, rest: bytes
    ) -> None:
        """Send a `WatchState` to the watchers that are due.

        A watcher that came while the frame was tracked sees the next one: the worker does not
        know yet what it asked for.

        Args:
            state: JSON.
            extras: of the worker, with frame, contour and silhouette.
            picture: JPEG, or nothing.
            rest: the last keys of the message, JSON without braces.
        """
        contour, outlines = to_json(extras["contour"]), to_json(extras["silhouette_px"])
        for watcher in self._due & self:
            shown = picture if watcher.width else b""
            text = (
                b'{"type":"state","state":%b,"contour":%b,"silhouette_px":%b,"image_follows":%b,%b}'
                % (
                    state,
                    contour if watcher.contour else b"null",
                    outlines if watcher.silhouette else b"null",
                    b"true" if shown else b"false",
                    rest,
                )
            )
            stamped = int(extras["frame"]).to_bytes(8, "little") + shown if shown else b""
            watcher.show(text, stamped)
            # Half a period of slack, so that frames a little early are not left out.
            watcher.due_s = max(
                watcher.due_s + 1.0 / watcher.rate_hz, now_s + 0.5 / watcher.rate_hz
            )
        self.wait()

    def restart(self) -> None:
        """All are due at once: another worker continues the session, and has no last frame."""
        self._stop_waiting()
        self._not_due, self._missed = set(), set()
        for watcher in self:
            watcher.due_s = 0.0

    def end(self, reason: str) -> None:
        """The session ends."""
        self._ended = reason
        self._stop_waiting()
        for watcher in self:
            watcher.end(reason)
