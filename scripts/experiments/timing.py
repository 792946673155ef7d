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
    """Seconds an answer: least of the medians of ``rounds`` turns, after a warm-up.

    ``seconds`` is for all of it; a turn has at least one call, so slow ways may take longer.
    """
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


def medians_in_turns_ms(
    ways: dict[str, Callable[[], object]], turns: int, seed: int = 0
) -> dict[str, float]:
    """Median milliseconds of some calls on the wall clock, taken in turns after a warm-up.

    The order of every turn is drawn: each way then starts with the caches that the others leave.
    """
    rng, spent = np.random.default_rng(seed), {name: list[float]() for name in ways}
    for call in ways.values():
        call()
    for _ in range(turns):
        for name in rng.permutation(list(ways)):
            start = time.perf_counter()
            ways[name]()
            spent[name].append(time.perf_counter() - start)
    return {name: 1e3 * float(np.median(times)) for name, times in spent.items()}


def median_ms(
    call: Callable[[], object], calls: int = 60, *, seconds: float = 0.0, rounds: int = 1
) -> float:
    """Median milliseconds of a call on the wall clock, after a warm-up; the least of ``rounds``.

    A round has at least ``calls`` calls, and lasts at least ``seconds``.
    """
    call()
    medians = []
    for _ in range(rounds):
        spent: list[float] = []
        until = time.perf_counter() + seconds
        while len(spent) < calls or time.perf_counter() < until:
            start = time.perf_counter()
            call()
            spent.append(time.perf_counter() - start)
        medians.append(1e3 * float(np.median(spent)))
    return min(medians)
