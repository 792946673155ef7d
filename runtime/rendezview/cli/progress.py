"""A progress bar for long work on a terminal, plain lines in a log; JSON where a program asks.

With ``RENDEZVIEW_PROGRESS=json`` in the environment each step is a line on stderr:
``{"stage": "views", "done": 3, "total": 10}``; what is odd about the inputs: ``{"doubt": "…"}``.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rendezview.sensors.observation import Status
from rendezview.sensors.run import Summary

# s; in a log a line follows the line before after so long. Source: a chosen limit
_EVERY_S = 30.0
# s; the same at the end of a stage, so that short stages say nothing. Source: a chosen limit
_END_S = 10.0
_MINUTES_S = 120.0  # s; from here on a time is in minutes. Source: a chosen limit


def outcome_words(outcomes: Counter[Status], good: Status) -> str:
    """The counts of all outcomes but the good one: `` (3 lost, 1 empty)``, or nothing."""
    others = ", ".join(f"{n} {status}" for status, n in outcomes.most_common() if status != good)
    return f" ({others})" if others else ""


def as_json() -> bool:
    """Whether a program reads the lines."""
    return os.environ.get("RENDEZVIEW_PROGRESS") == "json"


def say(text: str) -> None:
    """One line on stderr."""
    Console(stderr=True).print(text, highlight=False, soft_wrap=True)


def say_table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """A table on stderr."""
    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    Console(stderr=True).print(table)


def say_summary(summary: Summary, poses: int, total: int, *, what: str, step: str) -> None:
    """The last line of a run: ``57 poses in 60 frames (3 lost), median 1.2 ms a frame``."""
    times = summary.times_ms
    say(
        f"{poses} {what} in {total} {step}s"
        + outcome_words(summary.outcomes, Status.OK)
        + (f", median {statistics.median(times):.3g} ms a {step}" if times else "")
    )


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < _MINUTES_S else f"{seconds / 60.0:.0f} min"


@dataclass(slots=True)
class _Stage:
    """A stage of the work. An earlier run may have done a part: it begins at ``first``."""

    name: str
    done: int
    total: int
    first: int
    began_s: float
    updated_s: float
    left_s: float | None = None  # None: as fast as so far

    def words(self, now_s: float) -> str:
        """What, how far of how much, the time left."""
        of, spent_s = f"{self.name}: {self.done} of {self.total}", now_s - self.began_s
        if self.done >= self.total:
            words = f"{of} in {_duration(self.updated_s - self.began_s)}"
            since_s = now_s - self.updated_s
            return f"{words}; what follows takes {_duration(since_s)} so far" if since_s else words
        left_s, steps = self.left_s, self.done - self.first
        if left_s is None and steps > 0:
            left_s = spent_s / steps * (self.total - self.done)
        if left_s is None:
            return f"{of}, {_duration(spent_s)} so far"
        return f"{of}, about {_duration(left_s)} more"


class _Lines:
    """Lines on stderr: now and then, also while work counts nothing, and as a long stage ends."""

    def __init__(self) -> None:
        self._stage: _Stage | None = None
        self._stages: dict[str, _Stage] = {}
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._said_s = time.monotonic()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def update(self, name: str, done: int, total: int, left_s: float | None) -> None:
        if total <= 0:  # of a camera, which has no end
            return
        with self._lock:
            now_s, stage = time.monotonic(), self._stages.get(name)
            if stage is None or done < stage.done:
                stage = self._stages[name] = _Stage(name, done, total, done, now_s, now_s)
            stage.done, stage.total, stage.left_s, stage.updated_s = done, total, left_s, now_s
            self._stage = stage
            if done >= total:
                self._say_after(_END_S, now_s)

    def _watch(self) -> None:
        while not self._ended.wait(_EVERY_S / 10.0):
            with self._lock:
                self._say_after(_EVERY_S, time.monotonic())

    def _say_after(self, least_s: float, now_s: float) -> None:
        if self._stage is not None and now_s - self._said_s >= least_s:
            self._said_s = now_s
            say(self._stage.words(now_s))


class ProgressBar:
    """Bars by stage name, or lines where there is no terminal.

    Call it with stage, done, total and, where the steps differ much, the seconds left.
    """

    def __init__(self) -> None:
        # rich takes FORCE_COLOR, as of CI systems, for a terminal.
        is_terminal = sys.stderr.isatty()
        self._progress = Progress(
            TextColumn("{task.description:12}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not is_terminal,
        )
        self._tasks: dict[str, int] = {}
        self._as_json = as_json()
        self._lines = None if is_terminal or self._as_json else _Lines()

    def __enter__(self) -> Self:
        self._progress.start()
        if self._lines is not None:
            self._lines.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        if self._lines is not None:
            self._lines.stop()

    def stage(self, name: str, total: int) -> Callable[[int], None]:
        """What to call with the number of steps done of one stage, which begins now."""
        if total > 0:
            self(name, 0, total)
        return lambda done: self(name, done, total)

    def __call__(self, stage: str, done: int, total: int, left_s: float | None = None) -> None:
        if self._as_json:
            line = json.dumps({"stage": stage, "done": done, "total": total})
            print(line, file=sys.stderr, flush=True)
            return
        if self._lines is not None:
            self._lines.update(stage, done, total, left_s)
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._progress.update(
            self._progress.task_ids[self._tasks[stage]], completed=done, total=total
        )
