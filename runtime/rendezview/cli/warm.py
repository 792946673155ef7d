"""``rendezview warm``."""

from __future__ import annotations

from typing import Annotated

import typer

from rendezview.cli.compiling import GROUPS, compile_ahead
from rendezview.cli.progress import say
from rendezview.errors import RendezviewError


def warm(
    commands: Annotated[
        list[str] | None, typer.Argument(help=f"{', '.join(GROUPS)}; all if none is named.")
    ] = None,
) -> None:
    """Compile for this machine now what commands would compile when they first run.

    \b
    Example: rendezview warm track serve
    """
    for name in commands or ():
        if name not in GROUPS:
            raise RendezviewError(f"{name}: nothing is compiled for it; name {', '.join(GROUPS)}")
    compile_ahead(*(commands or GROUPS))
    say("Warm: the next start compiles nothing.")
