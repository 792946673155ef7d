"""One sender a session: frames of two would mix to a motion that nobody made."""

from __future__ import annotations

import math

SOURCE = "the service's source"  # the sender of its frames


class Taken(Exception):
    """Another sender has the session."""


class Lease:
    """Held by who sends frames, until it stops for a while or lets go."""

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._sender: str | None = None
        self._until_s = -math.inf

    def take(self, sender: str, now_s: float) -> None:
        """Take or renew the lease.

        Args:
            now_s: monotonic.

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
