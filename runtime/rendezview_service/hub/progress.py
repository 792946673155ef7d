"""What a session has tracked so far, and where its next tracker starts."""

from __future__ import annotations

import json

from pydantic import BaseModel, ConfigDict, PrivateAttr

from rendezview.errors import RendezviewError
from rendezview.sensors.appearance.verdict import LEAST_POSTERIOR
from rendezview_service.hub.clock import SessionClock
from rendezview_service.messages.message_parts import MOST_FIRST_S, MOST_JUMP_S, PoseMessage
from rendezview_service.messages.messages import Phase
from rendezview_service.messages.wire import Header

_PRIOR_S = 10.0  # s, for which a pose is the prior of another worker's tracker. Source: chosen


class Progress(BaseModel):
    """Counts and last states, as a checkpoint has them; what begins with _ stays here."""

    model_config = ConfigDict(extra="forbid")

    frames: int = 0  # tracked; the next one has this number
    found: int = 0  # of them, with a pose
    last: bytes | None = None  # the last `State`, JSON
    last_unix_s: float | None = None  # when it was answered, by a clock that never jumps
    last_found: bytes | None = None  # the last state with a pose, JSON
    found_unix_s: float | None = None
    _header: Header = PrivateAttr(default_factory=dict)  # of the last state, here
    _pose_s: float | None = None  # the frame's time of the last pose, here
    _clock: SessionClock = PrivateAttr(default_factory=SessionClock.started_now)

    def add(self, header: Header, state: bytes) -> None:
        """A state has come."""
        now_s = self._clock.now_unix_s
        self.frames += 1
        self.last, self._header, self.last_unix_s = state, header, now_s
        if self.phase is Phase.TRACKING:
            self.found += 1
            self.last_found, self.found_unix_s = state, now_s
            self._pose_s = header["time_s"]

    @property
    def phase(self) -> Phase:
        """Of the last state."""
        return Phase(self._header.get("phase", Phase.WAITING))

    @property
    def last_frame(self) -> int | None:
        """Number of the last state here."""
        return self._header.get("frame")

    @property
    def last_time_s(self) -> float | None:
        """Time of the last frame here."""
        return self._header.get("time_s")

    @property
    def prior(self) -> tuple[PoseMessage | None, float]:
        """The last pose, else the last fused one; None if both are old. And its posterior.

        No tracker gives a pose of a lower posterior than that, nor of a higher confidence.
        """
        found_age_s = self._age_s(self.found_unix_s)
        if self.last_found is not None and found_age_s is not None and found_age_s < _PRIOR_S:
            found = json.loads(self.last_found)
            posterior = max(found.get("confidence") or 0.0, LEAST_POSTERIOR)
            return PoseMessage.model_validate(found["pose"]), posterior
        kept, age_s = self.handover, self.age_s
        if kept is None or age_s is None or age_s >= _PRIOR_S:
            return None, 1.0
        return PoseMessage.model_validate(kept["pose"]), LEAST_POSTERIOR

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
        last_s = self.last_time_s
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
        return self._age_s(self.last_unix_s)

    @property
    def since_pose_s(self) -> float | None:
        """Time from the last pose to the last state, by the frames' times."""
        return None if self._pose_s is None else float(self._header["time_s"] - self._pose_s)

    def _age_s(self, unix_s: float | None) -> float | None:
        return None if unix_s is None else max(0.0, self._clock.now_unix_s - unix_s)
