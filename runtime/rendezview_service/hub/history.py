"""The last minutes of a session: states as they were sent, and pictures."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field

_MOST_MARKS_BYTES = 32_768  # bytes; more would be larger than their picture. Source: a chosen limit


@dataclass(slots=True)
class Histories:
    """What all sessions remember: with too many bytes, the one with the most forgets first."""

    most: int  # bytes
    held: int = 0
    _all: list[Past] = field(default_factory=list)

    def enter(self, past: Past) -> None:
        """A session begins."""
        self._all.append(past)

    def leave(self, past: Past) -> None:
        """A session has ended."""
        if past in self._all:
            self._all.remove(past)
            self.held -= past.held

    def count(self, past: Past, size: int) -> None:
        """So many bytes more, or fewer."""
        past.held += size
        if past in self._all:
            self.held += size
        while size > 0 and self.held > self.most:
            max(self._all, key=lambda one: one.held).forget()


@dataclass(slots=True, eq=False)
class Past:
    """States and pictures of the last minutes; bounded in time, number and bytes."""

    keep_s: float
    rate_hz: float
    image_hz: float
    histories: Histories
    held: int = 0  # bytes
    _states: deque[tuple[float, int, bytes]] = field(default_factory=deque)
    _images: deque[tuple[float, int, tuple[bytes, bytes]]] = field(default_factory=deque)
    _image_at_s: float = -1e300

    def add(self, now_s: float, frame: int, state: bytes) -> None:
        """Keep a state; of more than ``rate_hz`` a second, it takes the place of the last one."""
        kept = self._states
        if len(kept) > 1 and kept[-1][0] - kept[-2][0] < 0.9 / self.rate_hz:
            self.histories.count(self, -len(kept.pop()[2]))
        kept.append((now_s, frame, state))
        self._grown(now_s, len(state))

    def wants_image(self, now_s: float) -> bool:
        """Whether the next picture is kept."""
        return self.image_hz > 0.0 and now_s - self._image_at_s >= 0.9 / self.image_hz

    def add_image(self, now_s: float, frame: int, jpeg: bytes, marks: bytes = b"[]") -> None:
        """Keep a picture with the `Marks` of other sensors, a JSON list."""
        self._image_at_s = now_s
        kept = marks if len(marks) <= _MOST_MARKS_BYTES else b"[]"
        self._images.append((now_s, frame, (jpeg, kept)))
        self._grown(now_s, len(jpeg) + len(kept))

    def states(self, after_s: float, since_frame: int, most: int) -> list[tuple[int, bytes]]:
        """States since a time and a frame, evenly thinned to at most ``most``, newest included."""
        chosen = [(f, s) for at, f, s in self._states if at >= after_s and f >= since_frame]
        if len(chosen) <= most:
            return chosen
        step = -(-len(chosen) // most)
        return chosen[::-1][::step][::-1]

    def state(self, frame: int) -> bytes | None:
        """The state of a frame, or of the last one before it that is kept."""
        place = bisect_right(self._states, frame, key=lambda entry: entry[1])
        return self._states[place - 1][2] if place else None

    def image(self, frame: int) -> tuple[int, bytes, bytes] | None:
        """Number, picture and marks of a frame, or of the last one before it that is kept."""
        place = bisect_right(self._images, frame, key=lambda entry: entry[1])
        if not place:
            return None
        _, number, kept = self._images[place - 1]
        return number, *kept

    @property
    def image_frames(self) -> list[int]:
        """Frames whose picture is kept."""
        return [frame for _, frame, _ in self._images]

    def forget(self) -> None:
        """Forget the oldest picture or state."""
        if self._images and not (self._states and self._states[0][0] < self._images[0][0]):
            self.histories.count(self, -sum(map(len, self._images.popleft()[2])))
        else:
            self.histories.count(self, -len(self._states.popleft()[2]))

    def _grown(self, now_s: float, size: int) -> None:
        self.histories.count(self, size)
        for entries in (self._states, self._images):
            while entries and entries[0][0] < now_s - self.keep_s:
                self.forget()
