"""Runs a sensor over a sequence and writes results and a log: one loop for all commands."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from rendezview.errors import RendezviewError
from rendezview.io.results import JsonLinesWriter, ResultRow, json_line, partial, write_results
from rendezview.sensors.observation import Observation, Status

FrameT_co = TypeVar("FrameT_co", covariant=True)
ObservationT = TypeVar("ObservationT", bound=Observation)


class Source(Protocol[FrameT_co]):
    """One frame of a sequence, unread: a picture, a lit and a dark one, a reading."""

    @property
    def name(self) -> str: ...
    @property
    def time_s(self) -> float | None: ...
    def read(self) -> FrameT_co: ...


SourceT = TypeVar("SourceT", bound=Source[Any])


def observe(
    sources: Iterable[SourceT],
    look: Callable[[SourceT, float, Any], ObservationT],
    unreadable: Callable[[Status, str], ObservationT],
    *,
    ordered: bool = True,
) -> Iterator[tuple[SourceT, Any, ObservationT]]:
    """One observation for each frame, in order; nothing is lost on the way.

    Args:
        sources: frames; without times they count as one second apart.
        look: (source, time in seconds, frame) → observation.
        unreadable: makes the observation of a frame that cannot be read; the run goes on.
        ordered: the times must rise, because the sensor remembers the frames before.

    Yields:
        The source, its frame (``None`` where it cannot be read) and the observation.

    Raises:
        RendezviewError: the times of the frames do not rise.
    """
    last_s = -math.inf
    for index, source in enumerate(sources):
        time_s = float(index) if source.time_s is None else source.time_s
        try:
            frame = source.read()
        except RendezviewError as error:
            yield source, None, unreadable(Status.UNREADABLE, str(error))
            continue
        if ordered and not time_s > last_s:
            raise RendezviewError(
                f"the time of frame {source.name} ({time_s} s) is not later than that of the frame "
                f"before ({last_s} s): use --independent for a set of single frames"
            )
        last_s = time_s
        yield source, frame, look(source, time_s, frame)


@dataclass(frozen=True, slots=True)
class Line:
    """One step of a run, as it is written."""

    record: dict[str, Any]  # of the log
    status: Status | None = None  # None: not counted
    row: ResultRow | None = None  # of the results, where there is a pose
    spent_ms: float | None = None  # computing time


@dataclass(slots=True)
class Summary:
    """What became of a run."""

    outcomes: Counter[Status] = field(default_factory=Counter)
    rows: list[ResultRow] = field(default_factory=list)
    times_ms: list[float] = field(default_factory=list)

    @property
    def total(self) -> int:
        """How many steps were counted."""
        return sum(self.outcomes.values())


def run(
    lines: Iterable[Line],
    *,
    log: Path | None,
    results: Path | None = None,
    to_stdout: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Summary:
    """Take every step of a run and write it as it comes.

    Ctrl-C ends a run: log and results have all steps so far. After an exception they have them
    too, but keep names that end in ``.partial``. A log that cannot be written does not take the
    poses with it.

    Args:
        lines: the steps.
        log: JSON lines, or ``None``.
        results: BOP CSV, or ``None``.
        to_stdout: print the lines where there is no log.
        progress: called with the number of steps done.

    Raises:
        RendezviewError: a file cannot be written, or a step raised it.
    """
    summary = Summary()
    writer = JsonLinesWriter(log) if log else None
    ended = False
    try:
        for line in lines:
            if line.status is not None:
                summary.outcomes[line.status] += 1
            if line.spent_ms is not None:
                summary.times_ms.append(line.spent_ms)
            if line.row is not None:
                summary.rows.append(line.row)
            if writer:
                writer.write(line.record)
            elif to_stdout:
                print(json_line(line.record))
            if progress and line.status is not None:
                progress(summary.total)
        ended = True
    except KeyboardInterrupt:
        ended = True
        raise
    except RendezviewError as error:
        kept = [str(partial(path)) for path in (log, results) if path is not None]
        if not kept or not summary.outcomes:
            raise
        raise RendezviewError(f"{error}; the steps so far are in {' and '.join(kept)}") from error
    finally:
        try:
            if writer:
                writer.keep(ended)
        finally:
            if results is not None and summary.outcomes:
                write_results(results if ended else partial(results), summary.rows)
    return summary
