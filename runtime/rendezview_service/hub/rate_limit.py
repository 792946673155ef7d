"""A token bucket, for requests of a caller and for sensor lines of a session.

Own code, because the package ``limits`` has windows but no bucket: its fixed windows pass twice the
rate at their border, and it takes whole numbers only.
"""

from __future__ import annotations

from dataclasses import dataclass


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
