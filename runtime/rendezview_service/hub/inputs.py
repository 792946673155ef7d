"""What comes to a session: frames and lines of other sensors, who may send them, and refusals."""

from __future__ import annotations

import contextlib
import math
import mmap
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

from rendezview_service.messages.frames import Bytes
from rendezview_service.messages.wire import Header

SOURCE = "the service's source"  # the sender of its frames
_BARRED_S = 60.0  # s, after an input that ended a process. Source: chosen
_ENDED_S = 600.0  # s, for which a process that a session ended is remembered. Source: chosen


class Refused(Exception):
    """The service refuses something for now, with a reason."""

    status = 429  # of HTTP
    after_s = 1.0  # s, before it may be asked again


class Full(Refused):
    """No room: too many frames wait, or there are too many sessions."""

    def __str__(self) -> str:
        return "too many requests or lines wait, or too many sessions are open: try again later"


class Barred(Refused):
    """An input of the session ended its worker's process: none is taken for a while."""

    def __init__(self, left_s: float) -> None:
        super().__init__(
            "a frame or a line of this session ended the tracker's process: nothing is taken from "
            f"it for another {left_s:.0f} s. Send frames that a common program has written"
        )
        self.after_s = left_s


class Taken(Refused):
    """Another sender has the session."""

    status = 409


class NotReady(Refused):
    """No worker is ready at the moment."""

    status = 503

    def __init__(self, reason: str = "no worker process is ready: try again in a moment") -> None:
        super().__init__(reason)


class Worker(Protocol):
    """The process that tracks, as its sessions see it."""

    def wake(self, session: Any) -> None:
        """A session has an input waiting."""

    def forget(self, session: Any) -> None:
        """A session has ended."""

    async def ask(self, header: Header) -> Header:
        """A request other than an input, and its answer."""


@dataclass(slots=True, eq=False)
class Bar:
    """The processes that a session's inputs have ended, and for how long nothing is taken."""

    until_s: float = -math.inf  # monotonic
    ended_at_s: list[float] = field(default_factory=list)

    @property
    def left_s(self) -> float:
        """For how long nothing is taken, s; 0: it is."""
        return max(0.0, self.until_s - time.monotonic())

    def check(self) -> None:
        """Barred: nothing is taken."""
        if left_s := self.left_s:
            raise Barred(left_s)

    def ended(self, at_fault: bool) -> None:
        """A process ended over an input, which is perhaps at fault."""
        now_s = time.monotonic()
        if at_fault:
            self.until_s = now_s + _BARRED_S
        self.ended_at_s = [*(at_s for at_s in self.ended_at_s if now_s - at_s < _ENDED_S), now_s]


class Lease:
    """One sender a session: frames of two would mix to a motion that nobody made.

    It has the session until it stops for a while or lets go.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._sender: str | None = None
        self._until_s = -math.inf

    def take(self, sender: str, now_s: float) -> None:
        """Take or renew the lease, at a monotonic time.

        Raises:
            Taken: another sender holds it.
        """
        if self._sender not in (None, sender) and now_s < self._until_s:
            raise Taken(
                "another sender sends the frames of this session: open one of your own, or wait "
                f"until it has been silent for {self._hold_s:g} s"
            )
        self._sender, self._until_s = sender, now_s + self._hold_s

    def release(self, sender: str) -> None:
        """Let go of the lease, if it is this sender's."""
        if self._sender == sender:
            self._sender = None


@dataclass(slots=True, eq=False)
class Answer:
    """The answer to a frame or to sensor lines, or the reason why there is none."""

    status: int  # HTTP status; 0: the frame was dropped
    body: bytes  # a `State` or a `Measured`, JSON
    error: str = ""
    ends: bool = False  # no other follows: the session has ended here


@dataclass(slots=True, eq=False)
class SessionInput:
    """A frame to track, lines of another sensor to fuse, or the last frame to show again."""

    pieces: list[Bytes]  # its bytes, as they arrived; the worker's process has them in the end
    time_s: float
    received_unix_s: float
    received_s: float  # monotonic
    answer: Callable[[Answer], None]
    sensor: str | None = None  # the sensor of these lines; None: a frame
    sender: str = ""  # of a frame
    key: str | None = None  # of a frame; see `Once`
    roi: list[float] | None = None  # where in a frame the target is; None: not told
    waited_s: float = 0.0  # between the session's previous input and this one
    shows_last: bool = False  # it has no bytes: the last frame goes to watchers who missed it
    length: int = field(init=False)  # bytes

    def __post_init__(self) -> None:
        self.length = sum(map(len, self.pieces))

    @property
    def lines(self) -> int:
        """How many lines it can hold."""
        return 1 + sum(bytes(piece).count(b"\n") for piece in self.pieces)

    def move_to(self, memory: mmap.mmap) -> None:
        """Copy the bytes there and let them go."""
        place = 0
        for piece in self.pieces:
            memory[place : place + len(piece)] = piece
            place += len(piece)
        self.pieces.clear()


@dataclass(slots=True, eq=False)
class InputQueue:
    """Inputs in order of arrival; of the frames of streams only the newest waits."""

    _inputs: deque[SessionInput] = field(default_factory=deque)
    _newest: SessionInput | None = None  # frame of a stream or a source
    shows_last: SessionInput | None = None  # is taken when nothing else waits
    _closed: Answer | None = None  # to all that comes
    _streams: set[Callable[[Answer], None]] = field(default_factory=set)

    def __bool__(self) -> bool:
        return bool(self._inputs) or self._newest is not None or self.shows_last is not None

    def append(self, waiting: SessionInput) -> None:
        """An input that waits for those before it."""
        if self._closed is None:
            self._inputs.append(waiting)
        else:
            waiting.answer(self._closed)

    def replace(self, frame: SessionInput) -> SessionInput | None:
        """A frame of a stream; returns the frame that it drops."""
        if self._closed is not None:
            frame.answer(self._closed)
            return None
        dropped, self._newest = self._newest, frame
        return dropped

    def take(self) -> SessionInput | None:
        """Remove and return the input that arrived first."""
        newest = self._newest
        if newest is not None and (
            not self._inputs or newest.received_s <= self._inputs[0].received_s
        ):
            self._newest = None
            return newest
        if self._inputs:
            return self._inputs.popleft()
        shows_last, self.shows_last = self.shows_last, None
        return shows_last

    def count(self, *, frames: bool) -> int:
        """Number of appended frames, or of messages with sensor lines."""
        return sum((waiting.sensor is None) is frames for waiting in self._inputs)

    @contextlib.contextmanager
    def streaming(self, answer: Callable[[Answer], None]) -> Iterator[None]:
        """A stream that is open meanwhile; it is told of the end, whether it sends or not."""
        self._streams.add(answer)
        try:
            if self._closed is not None:
                answer(self._closed)
            yield
        finally:
            self._streams.discard(answer)

    def close(self, answer: Answer) -> None:
        """Answer all inputs and streams, and those that come later, on their way meanwhile."""
        waiting = [*self._inputs, *([] if self._newest is None else [self._newest])]
        self._inputs.clear()
        self._newest, self.shows_last, self._closed = None, None, answer
        for one in waiting:
            one.answer(answer)
        for stream in self._streams:
            stream(answer)


@dataclass(slots=True)
class TokenBucket:
    """Fills at ``per_s`` and holds what comes in one second."""

    per_s: float
    at_s: float  # monotonic, of the last refill
    level: float

    @classmethod
    def full(cls, per_s: float, now_s: float) -> TokenBucket:
        """A bucket that nothing has been taken from."""
        return cls(per_s, now_s, per_s)

    def refill(self, now_s: float) -> float:
        """Add what has come since the last call; the level."""
        self.level = min(self.per_s, self.level + (now_s - self.at_s) * self.per_s)
        self.at_s = now_s
        return self.level

    def spend(self, count: float) -> None:
        """Take so many; the level may become negative, which delays the next."""
        self.level -= count
