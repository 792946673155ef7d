"""Loads the compiled loops of sessions, or compiles them, before the first frame."""

from __future__ import annotations

from collections.abc import Callable

from numba.core.event import Event, Listener, install_listener

from rendezview.cli.compiling import load_ahead

LOOPS, SENSOR_LOOPS = ("track", "hard", "filter"), ("sensors",)  # groups, as `load_ahead` has them


class _Counted(Listener):
    """Counts the loops that are compiled."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        self.count = 0
        self._tell = tell

    def on_start(self, event: Event) -> None:
        """A loop is being compiled."""

    def on_end(self, event: Event) -> None:
        """A loop is compiled."""
        self.count += 1
        self._tell(self.count)


def warm_up(groups: tuple[str, ...], tell: Callable[[int], None] = lambda count: None) -> int:
    """Load groups of loops from the cache; the number of those that it lacked and were compiled.

    Fresh loops may round differently from those of the cache: restart a process that had to
    compile before you record its poses.

    Args:
        tell: receives the number of loops compiled so far, after each.
    """
    counted = _Counted(tell)
    with install_listener("numba:compile", counted):
        load_ahead(*groups)
    return counted.count
