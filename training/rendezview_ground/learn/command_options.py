"""Options that several commands of the ground side share."""

from __future__ import annotations

from typing import Annotated

import typer

Jobs = Annotated[int, typer.Option(help="Parallel jobs; -1 for all cores.")]
Dask = Annotated[
    str | None, typer.Option(help="Address of a Dask scheduler; its cluster does the work.")
]
