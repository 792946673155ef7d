"""A progress bar for long work, shown only on a terminal; lines of JSON where a program asks.

With ``RENDEZVIEW_PROGRESS=json`` in the environment each step is a line on stderr:
``{"stage": "views", "done": 3, "total": 10}``; what is odd about the inputs: ``{"doubt": "…"}``.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rendezview.sensors.observation import Status
from rendezview.sensors.run import Summary


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


class ProgressBar:
    """Bars by stage name; call it with stage, done and total."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description:12}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._tasks: dict[str, int] = {}
        self._as_json = as_json()
        self.is_shown = console.is_terminal or self._as_json

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def stage(self, name: str, total: int) -> Callable[[int], None]:
        """What to call with the number of steps done of one stage."""
        return lambda done: self(name, done, total)

    def __call__(self, stage: str, done: int, total: int) -> None:
        if self._as_json:
            line = json.dumps({"stage": stage, "done": done, "total": total})
            print(line, file=sys.stderr, flush=True)
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._progress.update(
            self._progress.task_ids[self._tasks[stage]], completed=done, total=total
        )
