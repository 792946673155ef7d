"""The loops that a run calls, as ``rendezview.cli.compiling`` lists them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from numba.core.dispatcher import Dispatcher

from rendezview.cli.compiling import type_to_json


def recorded(run: Callable[[], object]) -> list[dict[str, Any]]:
    """The loops that a run calls from Python, by types of arguments, with the seconds of each.

    With an empty cache the seconds are those of compiling; a loop that was compiled as a part of
    another is not listed then.
    """
    entries: list[dict[str, Any]] = []
    numba_s: Any = Dispatcher
    prepare = numba_s._compile_for_args

    def noted(self: Any, *arguments: Any) -> Any:
        start = time.process_time()
        try:
            return prepare(self, *arguments)
        finally:
            function = self.py_func
            entries.append(
                {
                    "loop": f"{function.__module__}:{function.__qualname__}",
                    "arguments": [type_to_json(self.typeof_pyval(a)) for a in arguments],
                    "seconds": round(time.process_time() - start, 1),
                }
            )

    numba_s._compile_for_args = noted
    try:
        run()
    finally:
        numba_s._compile_for_args = prepare
    return entries
