"""The last minutes of a session: states as they were sent, and pictures."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from typing import TypeVar

_MOST_MARKS_BYTES = 32_768  # bytes; more would be larger than their picture. Source: a chosen limit
Kept = TypeVar("Kept")


@dataclass(slots=True)
class Past:
    """States and pictures of the last minutes; bounded in time and number."""

    keep_s: float
    rate_hz: float
    image_hz: float
    _states: deque[tuple[float, int, bytes]] = field(default_factory=deque)
    _images: deque[tuple[float, int, tuple[bytes, bytes]]] = field(default_factory=deque)
    _newest: tuple[float, int, bytes] | None = None
    _image_at_s: float = -1e300

    def add(self, now_s: float, frame: int, state: bytes) -> None:
        """Keep a state, unless more than ``rate_hz`` come per second; the newest in any case."""
        self._newest = now_s, frame, state
        if self._states and now_s - self._states[-1][0] < 0.9 / self.rate_hz:
            return
        self._states.append((now_s, frame, state))
        _trim(self._states, now_s - self.keep_s)

    def wants_image(self, now_s: float) -> bool:
        """Whether the next picture is kept."""
        return self.image_hz > 0.0 and now_s - self._image_at_s >= 0.9 / self.image_hz

    def add_image(self, now_s: float, frame: int, jpeg: bytes, marks: bytes = b"[]") -> None:
        """Keep a picture with the `Marks` of other sensors, a JSON list."""
        self._image_at_s = now_s
        kept = marks if len(marks) <= _MOST_MARKS_BYTES else b"[]"
        self._images.append((now_s, frame, (jpeg, kept)))
        _trim(self._images, now_s - self.keep_s)

    def states(self, after_s: float, since_frame: int, most: int) -> list[tuple[int, bytes]]:
        """States since a time and a frame, evenly thinned to at most ``most``, newest included."""
        kept = [*self._states]
        if self._newest is not None and self._newest != kept[-1]:
            kept.append(self._newest)
        chosen = [(f, s) for at, f, s in kept if at >= after_s and f >= since_frame]
        if len(chosen) <= most:
            return chosen
        step = -(-len(chosen) // most)
        return chosen[::-1][::step][::-1]

    def state(self, frame: int) -> bytes | None:
        """The state of a frame, or of the last one before it that is kept."""
        if self._newest is not None and self._newest[1] <= frame:
            return self._newest[2]
        place = bisect_right(self._states, frame, key=lambda entry: entry[1])
        return self._states[place - 1][2] if place else None

    def image(self, frame: int) -> tuple[int, bytes] | None:
        """The picture of a frame, or of the last one before it that is kept."""
        kept = self._image_entry(frame)
        return None if kept is None else (kept[1], kept[2][0])

    def marks(self, frame: int) -> bytes | None:
        """The marks of the picture that `image` returns."""
        kept = self._image_entry(frame)
        return None if kept is None else kept[2][1]

    def _image_entry(self, frame: int) -> tuple[float, int, tuple[bytes, bytes]] | None:
        place = bisect_right(self._images, frame, key=lambda entry: entry[1])
        return self._images[place - 1] if place else None

    @property
    def image_frames(self) -> list[int]:
        """Frames whose picture is kept."""
        return [frame for _, frame, _ in self._images]


def _trim(entries: deque[tuple[float, int, Kept]], oldest_s: float) -> None:
    while entries and entries[0][0] < oldest_s:
        entries.popleft()
