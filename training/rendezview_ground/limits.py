"""Limits of numbers in options."""

from __future__ import annotations

import math

from rendezview.errors import RendezviewError

POSITIVE = math.ulp(0.0)  # as the lowest value: 0 is refused


def check(options: object, low: float, high: float, *names: str) -> None:
    """Refuse options that are not finite numbers from ``low`` to ``high``; None is none.

    Raises:
        RendezviewError: names the option, its limits and its value.
    """
    for name in names:
        value = getattr(options, name)
        values = value if isinstance(value, tuple) else (value,)
        if all(v is None or (math.isfinite(v) and low <= v <= high) for v in values):
            continue
        words = "finite" if low == -math.inf else f"{low:g} or more"
        if low == POSITIVE:
            words = "positive" if high == math.inf else f"positive, at most {high:g}"
        elif high < math.inf:
            words = f"{low:g} to {high:g}"
        raise RendezviewError(f"{name} must be {words}, not {value}")


def check_rising(options: object, *names: str) -> None:
    """Refuse ranges of options that are not (low, high).

    Raises:
        RendezviewError: names the option and its value.
    """
    for name in names:
        value = getattr(options, name)
        if not (len(value) == 2 and value[0] <= value[1]):
            raise RendezviewError(f"{name} must be a range (low, high), not {value}")
