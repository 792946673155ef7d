"""A browser for tests that take one step after another."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable
from typing import Any

_HANG_S = 600.0  # a guard only: playwright's own limits are shorter


class Stepwise:
    """An object of playwright's asynchronous interface, each step of which is waited for.

    The steps run in ``loop``, which another thread runs: playwright's synchronous interface would
    leave a running loop in the thread of the tests, where no other test could run its own.
    """

    def __init__(self, target: Any, loop: asyncio.AbstractEventLoop) -> None:
        self._target, self._loop = target, loop

    def _done(self, step: Callable[[Any], Any]) -> Any:
        async def value_of() -> Any:
            value = step(self._target)
            return await value if inspect.isawaitable(value) else value

        value = asyncio.run_coroutine_threadsafe(value_of(), self._loop).result(_HANG_S)
        more = callable(value) or type(value).__module__.startswith("playwright.")
        return Stepwise(value, self._loop) if more else value

    def __getattr__(self, name: str) -> Any:
        return self._done(lambda target: getattr(target, name))

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._done(lambda target: target(*arguments, **options))

    def __enter__(self) -> Any:
        return self._done(lambda target: target.__aenter__())

    def __exit__(self, *error: object) -> None:
        self._done(lambda target: target.__aexit__(*error))
