"""The falsy value returned where data give no answer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class NoFit:
    """No fit, and why. False, so that ``if not segment`` reads as it should."""

    reason: str

    def __bool__(self) -> bool:
        return False
