"""``rendezview catalogue``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from rendezview.cli.progress import ProgressBar
from rendezview.errors import RendezviewError
from rendezview_ground.learn.catalogue import read_catalogue, train_catalogue
from rendezview_ground.learn.command_options import Dask, Jobs
from rendezview_ground.learn.jobs.open_executor import open_executor


def catalogue(
    file: Annotated[Path, typer.Argument(help="Catalogue, TOML: targets, shells, lighting.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the models.")],
    jobs: Jobs = -1,
    dask: Dask = None,
    at_once: Annotated[
        int | None,
        typer.Option(
            min=1, help="Models at a time; default 1, or 3 on a cluster.", show_default=False
        ),
    ] = None,
) -> None:
    """Train models of many targets, with several sets of shells and lighting.

    Existing models are kept. Repeat the command to continue after an interruption.

    Example: rendezview catalogue targets.toml -o models --dask tcp://host:8786
    """
    console = Console(stderr=True)
    entries = read_catalogue(file)
    start = time.perf_counter()
    with (
        open_executor(jobs, dask, tell=lambda line: console.print(line, style="dim")) as executor,
        ProgressBar() as progress,
    ):
        outcome = train_catalogue(
            entries, output, executor, at_once=at_once or (3 if dask else 1), progress=progress
        )
    console.print(
        f"{output}: {len(outcome.trained)} models trained, {len(outcome.there_already)} existed "
        f"already, in {time.perf_counter() - start:.0f} s",
        highlight=False,
        soft_wrap=True,
    )
    if outcome.refused:
        why = "; ".join(f"{name}: {reason}" for name, reason in outcome.refused.items())
        raise RendezviewError(f"{len(outcome.refused)} of {len(entries)} not trained: {why}")
