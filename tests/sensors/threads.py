"""What threads that share something must give: the same bytes as one thread."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rendezview.io.results import json_line

THREADS = 4


def text_of(observation: Any, *left_out: str) -> str:
    """An observation's line without its times."""
    line = observation.record()
    return json_line({k: v for k, v in line.items() if k not in ("stage_ms", "time_s", *left_out)})


def together(task: Callable[[Any], Any], each: Iterable[Any]) -> list[Any]:
    """What a task gives for each, on several threads at once."""
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(task, each))


def assert_shared(task: Callable[[Any], Any], each: list[Any], times: int = 3) -> list[Any]:
    """Threads give what one thread gives, time and again; that."""
    serial = [task(one) for one in each]
    for _ in range(times):
        assert together(task, each) == serial
    return serial


def assert_one_after_the_other(update: Callable[[float], str], count: int) -> None:
    """Calls of one sensor at any times, of which each answer is the same: late ones are refused."""
    serial = update(0.0)

    def look(k: int) -> str | None:
        try:
            return update(1.0 + k)
        except ValueError:  # a later one came first
            return None

    taken = set(together(look, range(count))) - {None}
    assert taken == {serial}
