"""Times several ways of doing one thing in turns: a busy machine then disturbs all of them alike.

The clock is the processor time of this process: waiting for a core does not count, and work in
other threads does. Where a way runs in another process, all of that race are on the wall clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Way:
    """A call, and how many answers it gives; ``own_clock``: it returns seconds an answer."""

    call: Callable[[], Any]
    answers: int = 1
    own_clock: bool = False


def race(ways: dict[str, Way], seconds: float, rounds: int = 15) -> dict[str, float]:
    """Seconds an answer: least of the medians of ``rounds`` turns; ``seconds``: for all of it."""
    other_process = any(way.own_clock for way in ways.values())
    now = time.perf_counter if other_process else time.process_time
    for way in ways.values():
        way.call()
    best = dict.fromkeys(ways, np.inf)
    for k in range(rounds):
        for name in list(ways) if k % 2 else list(reversed(ways)):
            way, spent = ways[name], list[float]()
            until = time.perf_counter() + seconds / (rounds * len(ways))
            while not spent or time.perf_counter() < until:
                start = now()
                returned = way.call()
                took = now() - start
                spent.append(float(returned) if way.own_clock else took / way.answers)
            best[name] = min(best[name], float(np.median(spent)))
    return best
