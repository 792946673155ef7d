"""``rendezview replay``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import cv2
import typer
from rich.console import Console

from rendezview.errors import RendezviewError, optional
from rendezview.io.results import JsonLinesWriter

_AGAIN = "RENDEZVIEW_REPLAY_AGAIN"


def replay(
    log: Annotated[Path, typer.Argument(help="Log of `rendezview serve --record` (*.mcap).")],
    model: Annotated[
        Path | None, typer.Option(help="Model file, where the log does not hold it.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The states again, JSON lines.")
    ] = None,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Differences allowed; compiled on another machine: 1e-9.")
    ] = 0.0,
    mend: Annotated[
        bool,
        typer.Option(
            "--mend",
            help="Only complete a log that was cut off; of a damaged one make a whole copy.",
        ),
    ] = False,
) -> None:
    """Repeat a recorded run and compare it, bit for bit; or mend a log that was cut off.

    \b
    Example: rendezview replay run.mcap
    """
    with optional("`rendezview replay` needs", "service", ", which is not installed"):
        from rendezview_service.logs import log_repair
        from rendezview_service.logs.replay import model_of, read_log, repeat
        from rendezview_service.worker.worker_models import LOOPS, SENSOR_LOOPS, warm_up
    console = Console(stderr=True)

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    if mend:
        done = log_repair.mend(log)
        if done is None:
            say(f"{log}: whole")
        elif done.path == log:
            say(f"{log}: completed; {done.cut_bytes} bytes at its end cut")
        else:
            say(
                f"{log}: damaged; {done.path.name} has all but {done.damaged_bytes} bytes of it, "
                f"and {done.cut_bytes} at its end"
            )
        return
    opened = read_log(log)
    used = model_of(opened, model)
    cv2.setNumThreads(1)
    if warm_up(LOOPS + SENSOR_LOOPS) and _AGAIN not in os.environ:
        # Freshly compiled code may round differently from code read from the cache.
        os.environ[_AGAIN] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    result = None
    writer = JsonLinesWriter(output) if output else None
    try:
        for state, so_far in repeat(opened, used):
            result = so_far
            if writer:
                writer.write(state)
    finally:
        if writer:
            writer.close()
    if result is None:
        raise RendezviewError(f"{log}: holds no frame")
    if result.gap is not None:
        say(result.gap)
    counted = f"{result.frames} frames, {result.poses} poses"
    if result.lines:
        counted += f", {result.lines} lines of other sensors"
    if result.largest > tolerance:
        raise RendezviewError(
            f"{log}: {result.differing} of {result.frames + result.lines} differ, by up to "
            f"{result.largest:.1e}, first {result.first_difference}: another version or model; or, "
            "where it is rounding, loops that were compiled apart (see --tolerance)"
        )
    if result.differing:
        say(f"{counted}: {result.differing} differ, by at most {result.largest:.1e}")
    else:
        say(f"{counted}: all repeated bit for bit")
