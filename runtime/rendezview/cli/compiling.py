"""Compiles loops ahead, on all cores, and says so.

numba compiles a loop when it is first called and keeps it in a cache on disk, once per machine.
One process compiles one loop at a time. Where the cache is empty, a command therefore starts
processes that compile the loops it will need side by side, and then loads them from the cache.
Which loops those are, for which types of arguments, is listed in ``loops.json``;
``python -m experiments compiled-loops`` writes that list.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.core.event import Event, Listener, install_listener, register

from rendezview.cli.progress import say

_MOST_PROCESSES = 6  # with more, each mostly imports. Source: experiment compiled-loops
# Source: experiment compiled-loops, twice the start of a process
_LEAST_S = 4.0  # s; what takes less to compile is compiled where it is called


def load_loops(group: str) -> list[dict[str, Any]]:
    """The loops of a group, the slowest to compile first: ``loop``, ``arguments``, ``seconds``."""
    text = resources.files("rendezview.cli").joinpath("loops.json").read_text()
    return sorted(json.loads(text)[group], key=lambda entry: -float(entry["seconds"]))


def type_to_json(kind: Any) -> Any:
    """A numba type of an argument as JSON has it.

    Raises:
        TypeError: no loop takes such an argument.
    """
    if isinstance(kind, types.Array):
        return {"array": [str(kind.dtype), kind.ndim, kind.layout, not kind.mutable]}
    if isinstance(kind, types.BaseNamedTuple):
        home: type = kind.instance_class  # type: ignore[attr-defined]
        members = [type_to_json(member) for member in kind.types]  # type: ignore[attr-defined]
        return {"named": f"{home.__module__}:{home.__qualname__}", "of": members}
    if isinstance(kind, types.BaseTuple):
        return {"tuple": [type_to_json(member) for member in kind.types]}  # type: ignore[attr-defined]
    if isinstance(kind, types.Number | types.Boolean):
        return str(kind)
    raise TypeError(f"an argument of type {kind}")


def type_from_json(given: Any) -> Any:
    """The inverse of ``type_to_json``."""
    if isinstance(given, str):
        return types.boolean if given == "bool" else getattr(types, given)
    if "array" in given:
        dtype, ndim, layout, readonly = given["array"]
        return types.Array(type_from_json(dtype), ndim, layout, readonly=readonly)
    members = [type_from_json(member) for member in given.get("of", given.get("tuple"))]
    if "named" in given:
        home = _named(given["named"])
        return types.BaseTuple.from_types(members, home)  # type: ignore[no-untyped-call]
    return types.BaseTuple.from_types(members)  # type: ignore[no-untyped-call]


def compile_ahead(*groups: str) -> None:
    """Compile the loops of some groups that the cache on disk lacks, in several processes.

    Nothing is done where numba keeps no cache. A loop that cannot be compiled here is left to its
    first call.
    """
    entries = [entry for group in groups for entry in load_loops(group)]
    missing = [entry for entry in entries if not _is_cached(_named(entry["loop"]))]
    if sum(float(e["seconds"]) for e in missing) < _LEAST_S or os.environ.get(
        "NUMBA_DISABLE_JIT", "0"
    ) not in ("", "0"):
        return
    shares = _shares(missing, min(_MOST_PROCESSES, _cores()))
    seconds = max(sum(float(e["seconds"]) for e in share) for share in shares)
    say(
        f"Compiling {len(missing)} loops for this machine in {len(shares)} processes, only once: "
        f"about {seconds + _START_S:.0f} s …"
    )
    start = time.perf_counter()
    command = [sys.executable, "-m", "rendezview.cli.compiling"]
    workers = [
        subprocess.Popen([*command, json.dumps(share)], stderr=subprocess.DEVNULL)
        for share in shares
    ]
    try:
        for worker in workers:
            worker.wait()
    finally:
        for worker in workers:
            worker.kill()
    say(f"Compiled in {time.perf_counter() - start:.0f} s")


_START_S = 2.0  # s; of a process, before it compiles. Source: experiment compiled-loops


def tell_of_compiling() -> None:
    """From now on, one line on stderr when this process begins to compile a loop itself."""
    register("numba:compile", _Teller(say))  # type: ignore[no-untyped-call]


class _Teller(Listener):
    """Says once that loops are being compiled."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._told = False

    def on_start(self, event: Event) -> None:
        """A loop is being compiled."""
        if not self._told:
            self._told = True
            self._tell("Compiling loops for this machine, only once …")

    def on_end(self, event: Event) -> None:
        """A loop is compiled."""


def _named(name: str) -> Any:
    """What ``module:name`` names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _is_cached(loop: Any) -> bool:
    """Whether the cache on disk has an index of a loop that is no older than its source."""
    folder = loop.stats.cache_path
    if folder is None:  # no cache is kept
        return True
    function = loop.py_func
    stem = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
    source = Path(function.__code__.co_filename)
    first = function.__code__.co_firstlineno
    indices = Path(folder).glob(f"{stem}-{first}.py*.nbi")
    try:
        return any(i.stat().st_mtime >= source.stat().st_mtime for i in indices)
    except OSError:
        return False


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _shares(entries: Sequence[dict[str, Any]], count: int) -> list[list[dict[str, Any]]]:
    """Shares of about the same seconds; the slowest loops are dealt first."""
    shares: list[list[dict[str, Any]]] = [[] for _ in range(min(count, len(entries)))]
    spent = np.zeros(len(shares))
    for entry in entries:
        least = int(np.argmin(spent))
        shares[least].append(entry)
        spent[least] += float(entry["seconds"])
    return shares


class Recorder(Listener):
    """Notes the loops that Python calls and numba compiles, with the seconds that each took."""

    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = []
        self._starts: list[float] = []

    def on_start(self, event: Event) -> None:
        """A loop is being compiled, perhaps within another."""
        self._starts.append(time.process_time())

    def on_end(self, event: Event) -> None:
        """A loop is compiled."""
        seconds = time.process_time() - self._starts.pop()
        if self._starts:
            return
        function = event.data["dispatcher"].py_func
        self.entries.append(
            {
                "loop": f"{function.__module__}:{function.__qualname__}",
                "arguments": [type_to_json(kind) for kind in event.data["args"]],
                "seconds": round(seconds, 1),
            }
        )


def recorded(run: Callable[[], None]) -> list[dict[str, Any]]:
    """The loops that a run has to compile; an empty cache lists all that it uses."""
    recorder = Recorder()
    with install_listener("numba:compile", recorder):
        run()
    return recorder.entries


def _compile(entries: list[dict[str, Any]]) -> None:
    """Compile loops; one that has changed since it was listed is left to its first call."""
    for entry in entries:
        with contextlib.suppress(NumbaError, AttributeError, ImportError, TypeError):
            loop = _named(entry["loop"])
            loop.compile(tuple(type_from_json(argument) for argument in entry["arguments"]))


if __name__ == "__main__":
    _compile(json.loads(sys.argv[1]))
