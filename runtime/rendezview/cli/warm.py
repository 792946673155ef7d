"""``rendezview warm``."""

from __future__ import annotations

from typing import Annotated

import typer

from rendezview.cli.compiling import COMMANDS, compile_ahead
from rendezview.cli.progress import say
from rendezview.errors import RendezviewError


def warm(
    commands: Annotated[
        list[str] | None, typer.Argument(help=f"{', '.join(COMMANDS)}; all if none is named.")
    ] = None,
) -> None:
    """Compile for this machine now what commands would compile when they first run.

    \b
    Example: rendezview warm track serve
    """
    named = commands or list(COMMANDS)
    for name in named:
        if name not in COMMANDS:
            raise RendezviewError(f"{name}: nothing is compiled for it; name {', '.join(COMMANDS)}")
    compile_ahead(*(group for name in named for group in COMMANDS[name]))
    say("Warm: the next start compiles nothing.")
