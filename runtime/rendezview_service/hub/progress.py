"""What a session has tracked so far, and where its next tracker starts."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field

from rendezview.errors import RendezviewError
from rendezview_service.hub.checkpoint import Tracked
from rendezview_service.messages.message_parts import MOST_FIRST_S, MOST_JUMP_S, PoseMessage
from rendezview_service.messages.messages import Phase
from rendezview_service.messages.wire import Header

_PRIOR_S = 10.0  # s, for which a pose is the prior of another worker's tracker. Source: chosen


@dataclass(slots=True)
class Progress:
    """Counts and last states; times ``…_at_s`` are monotonic."""

    frames: int = 0  # tracked; the next one has this number
    found: int = 0  # of them, with a pose
    last: bytes | None = None  # the last `State`, JSON
    header: Header = field(default_factory=dict)  # of the last state
    last_at_s: float | None = None
    last_found: bytes | None = None  # the last state with a pose, JSON
    found_at_s: float = -math.inf
    pose_s: float | None = None  # the frame's time of the last pose
    phase: Phase = Phase.WAITING

    def add(self, header: Header, state: bytes) -> None:
        """A state has come."""
        self.frames += 1
        self.last, self.header, self.last_at_s = state, header, time.monotonic()
        self.phase = Phase(header["phase"])
        if self.phase is Phase.TRACKING:
            self.found += 1
            self.last_found, self.found_at_s = state, self.last_at_s
            self.pose_s = header["time_s"]

    @property
    def prior(self) -> PoseMessage | None:
        """The last pose, else the last fused one; None if both are old."""
        if self.last_found is None or time.monotonic() - self.found_at_s >= _PRIOR_S:
            kept, age_s = self.handover, self.age_s
            if kept is None or age_s is None or age_s >= _PRIOR_S:
                return None
            return PoseMessage.model_validate(kept["pose"])
        return PoseMessage.model_validate(json.loads(self.last_found)["pose"])

    @property
    def handover(self) -> Header | None:
        """The last `Fused` state, if it has a pose: the next filter goes on from it."""
        fused = {} if self.last is None else json.loads(self.last).get("fused") or {}
        return fused if fused.get("pose") is not None else None

    def check_time(self, time_s: float) -> None:
        """Refuse a frame that would keep all later ones out.

        Raises:
            RendezviewError: its time is far ahead of that of the last one.
        """
        last_s = self.header.get("time_s")
        if last_s is None and self.last is not None:  # of another service
            last_s = json.loads(self.last)["time_s"]
        ahead_s = MOST_JUMP_S + (self.age_s or 0.0)
        if time_s > (MOST_FIRST_S if last_s is None else last_s + ahead_s):
            clock = "of a session that begins" if last_s is None else f"({last_s}) by {ahead_s:g} s"
            raise RendezviewError(
                f"time_s: {time_s} is too far ahead of the clock {clock}: correct the sender's "
                "clock, or open another session"
            )

    @property
    def age_s(self) -> float | None:
        """Time since the last state."""
        return None if self.last_at_s is None else time.monotonic() - self.last_at_s

    @property
    def since_pose_s(self) -> float | None:
        """Time from the last pose to the last state, by the frames' times."""
        return None if self.pose_s is None else float(self.header["time_s"] - self.pose_s)

    def tracked(self) -> Tracked:
        """What another service needs of it."""
        last, found = self.last, self.last_found
        age_s = time.monotonic() - self.found_at_s
        return Tracked(
            frames=self.frames,
            found=self.found,
            last=None if last is None else last.decode(),
            last_unix_s=None if self.age_s is None else time.time() - self.age_s,
            last_found=None if found is None else found.decode(),
            found_unix_s=None if found is None else time.time() - age_s,
        )

    def resume(self, tracked: Tracked) -> None:
        """Go on where another service was."""
        self.frames, self.found = tracked.frames, tracked.found
        if tracked.last is not None:
            self.last = tracked.last.encode()
            if tracked.last_unix_s is not None:
                self.last_at_s = time.monotonic() - max(0.0, time.time() - tracked.last_unix_s)
        if tracked.last_found is not None and tracked.found_unix_s is not None:
            self.last_found = tracked.last_found.encode()
            self.found_at_s = time.monotonic() - max(0.0, time.time() - tracked.found_unix_s)
