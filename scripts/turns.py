"""Times several ways of doing one thing in turns, so that a busy machine disturbs all of them alike.

The clock is the processor time of this process: waiting for a core does not count, and work in
other threads does. Where a way runs in another process, all ways of that race are on the wall clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Way:
    """A call, and how many answers it gives; ``own_clock``: it returns the seconds of one answer."""

    call: Callable[[], object]
    answers: int = 1
    own_clock: bool = False


def race(
    ways: dict[str, Way], seconds: float, rounds: int = 15, clock: str = "processor"
) -> dict[str, float]:
    """Seconds an answer: least of the medians of ``rounds`` turns, after a warm-up.

    ``seconds`` is for all of it; each turn has at least one call, so slow ways may take longer.
    """
    now = time.process_time if clock == "processor" else time.perf_counter
    for way in ways.values():
        way.call()
    best = dict.fromkeys(ways, np.inf)
    for k in range(rounds):
        names = list(ways) if k % 2 else list(reversed(ways))
        for name in names:
            way, spent = ways[name], []
            until = time.perf_counter() + seconds / (rounds * len(ways))
            while not spent or time.perf_counter() < until:
                start = now()
                returned = way.call()
                spent.append(returned if way.own_clock else (now() - start) / way.answers)
            best[name] = min(best[name], float(np.median(spent)))
    return best
