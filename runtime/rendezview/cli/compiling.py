"""Compiles loops ahead, on all cores, and says so.

numba compiles a loop when it is first called and keeps it in a cache on disk, once per machine.
One process compiles one loop at a time. Where the cache is empty, a command therefore starts
processes that compile the loops it will need beside it, and then loads those from the cache.
Which loops those are, for which types of arguments, is listed in ``loops.json``;
``python -m experiments compiled-loops`` writes that list.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numba.core.caching import IndexDataCacheFile
from numba.core.errors import NumbaError
from numba.core.event import Event, Listener, register
from numba.core.lowering import Lower

from rendezview.cli.progress import ProgressBar, say
from rendezview.io.file_lock import lock

# By command, the groups of loops.json that it calls; those that are needed first come first.
COMMANDS = {
    "track": ("track", "hard"),
    "train": ("train",),
    "demo": ("train", "track", "hard", "demo"),
    "serve": ("track", "hard", "sensors"),
    "reflectors": ("reflectors",),
    "stereo": ("stereo",),
}
GROUPS = tuple(dict.fromkeys(group for groups in COMMANDS.values() for group in groups))
_MOST_PROCESSES = 6  # with more, each mostly imports. Source: experiment compiled-loops
_ahead = threading.Event()  # set while this process compiles loops ahead
# Source: experiment compiled-loops, twice the start of a process
_LEAST_S = 4.0  # s; what takes less to compile is compiled where it is called


def load_loops(group: str) -> list[dict[str, Any]]:
    """The loops of a group, the slowest to compile first: ``loop``, ``arguments``, ``seconds``.

    With 0 seconds it is compiled as a part of another.
    """
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
    missing = _missing(groups)
    if not missing:
        return
    own, *others = _shares(missing, min(_MOST_PROCESSES, _cores()))
    seconds = max(_seconds(share) for share in (own, *others)) + _START_S
    if hasattr(os, "getloadavg"):  # what else runs gets its part of the cores
        seconds *= max(1.0, (os.getloadavg()[0] + 1 + len(others)) / _cores())
    say(
        f"Compiling {len(missing)} loops for this machine in {1 + len(others)} processes, "
        f"only once: about {seconds:.0f} s …"
    )
    start = time.perf_counter()
    workers = [_worker(share, "--count") for share in others]
    try:
        with ProgressBar() as bar:
            counter = _Counter(missing, 1 + len(others), bar)
            readers = [threading.Thread(target=counter.follow, args=(w,)) for w in workers]
            for reader in readers:
                reader.start()
            _compile(own, counter)
            for reader in readers:
                reader.join()
        for worker in workers:
            worker.wait()
    finally:
        for worker in workers:
            worker.kill()
    say(f"Compiled in {time.perf_counter() - start:.0f} s")


def load_ahead(*groups: str) -> None:
    """Load the loops of some groups from the cache, in this process; it compiles what is missing.

    Always in the same order: it decides which compiled copy of a shared loop the process uses, and
    copies that were compiled separately may round differently.
    """
    loops = [entry for group in groups for entry in load_loops(group)]
    _compile(sorted(loops, key=lambda entry: float(entry["seconds"])))


class _Counter:
    """Counts the loops that several processes have compiled, and the seconds that are left."""

    def __init__(self, loops: Sequence[dict[str, Any]], processes: int, bar: ProgressBar) -> None:
        self._total, self._bar, self._lock = len(loops), bar, threading.Lock()
        # Seconds of the machine of the list: of the start of the processes, and of all.
        self._done, self._spent = 0, processes * _START_S
        self._seconds = self._spent + _seconds(loops) + self._total * _EACH_S
        self._start = time.perf_counter()

    def __call__(self, seconds: float) -> None:
        """One more loop is compiled, which takes so long on the machine of the list."""
        with self._lock:
            self._done, self._spent = self._done + 1, self._spent + seconds + _EACH_S
            rest = max(self._seconds - self._spent, 0.0)
            left_s = (time.perf_counter() - self._start) * rest / self._spent
            self._bar("compile", self._done, self._total, left_s)

    def follow(self, worker: subprocess.Popen[bytes]) -> None:
        """Count what a process compiles, until it ends."""
        assert worker.stdout is not None
        with worker.stdout as lines:
            for line in lines:
                self(float(line))


class Beside:
    """Loops that are compiled in processes of low priority."""

    def __init__(self, missing: list[dict[str, Any]]) -> None:
        self._count = len(missing)
        shares = _shares(missing, min(_MOST_PROCESSES, _cores())) if missing else []
        self._workers = [_worker(share, "--beside") for share in shares]

    @property
    def is_busy(self) -> bool:
        """Whether some are still being compiled."""
        return any(worker.poll() is None for worker in self._workers)

    def wait(self) -> None:
        """Return when all are compiled."""
        if self.is_busy:
            say(f"Compiling the last of {self._count} more loops for this machine, only once …")
        for worker in self._workers:
            worker.wait()

    def stop(self) -> None:
        """End the processes; what they have compiled is kept."""
        for worker in self._workers:
            worker.kill()
            worker.wait()


@contextlib.contextmanager
def compile_beside(*groups: str) -> Iterator[Beside]:
    """Meanwhile compile the loops of some groups that the cache lacks, beside the work."""
    beside = Beside(_missing(groups))
    try:
        with _saved_in_turn():
            yield beside
    finally:
        beside.stop()


def _missing(groups: Sequence[str]) -> list[dict[str, Any]]:
    """The loops of some groups that the cache on disk lacks; none if they take no time."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return []
    listed = (entry for group in groups for entry in load_loops(group))
    entries = {(e["loop"], json.dumps(e["arguments"])): e for e in listed}.values()
    missing = [e for e in entries if not _is_cached(_named(e["loop"])) and e["seconds"]]
    return missing if _seconds(missing) >= _LEAST_S else []


def _worker(share: list[dict[str, Any]], *options: str) -> subprocess.Popen[bytes]:
    """A process that compiles a share."""
    command = [sys.executable, "-m", "rendezview.cli.compiling", *options, json.dumps(share)]
    out = subprocess.PIPE if "--count" in options else subprocess.DEVNULL
    return subprocess.Popen(command, stdout=out, stderr=subprocess.DEVNULL)


_START_S = 2.0  # s; of a process, before it compiles. Source: experiment compiled-loops
# s; of a loop beside what is listed: parts that loops share. Source: the same
_EACH_S = 0.3


def tell_of_compiling() -> None:
    """From now on, one line on stderr when this process compiles a loop, but for those ahead."""
    once = cache(lambda: say("Compiling loops for this machine, only once …"))
    began = Compiling(began=lambda: None if _ahead.is_set() else once())
    register("numba:compile", began)  # type: ignore[no-untyped-call]


class Compiling(Listener):
    """Calls back when this process begins to compile a loop, and when that is done."""

    def __init__(
        self, began: Callable[[], None] = lambda: None, done: Callable[[], None] = lambda: None
    ) -> None:
        self._began, self._done = began, done

    def on_start(self, event: Event) -> None:
        """A loop is being compiled."""
        self._began()

    def on_end(self, event: Event) -> None:
        """A loop is compiled."""
        self._done()


def _named(name: str) -> Any:
    """What ``module:name`` names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _is_cached(loop: Any) -> bool:
    """Whether the cache on disk has a version of a loop from its source as it is now.

    numba decides by the source's contents, not by its date. An index with types that have moved
    since is removed: numba would fail on it.
    """
    if loop.stats.cache_path is None:  # no cache is kept
        return True
    try:
        return bool(loop._cache._cache_file._load_index())
    except (AttributeError, ImportError):
        Path(loop._cache._cache_file._index_path).unlink(missing_ok=True)
        return False
    except (OSError, EOFError, ValueError, pickle.UnpicklingError):
        return False


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _shares(entries: Sequence[dict[str, Any]], count: int) -> list[list[dict[str, Any]]]:
    """Shares of about the same seconds, the longest first; the slowest loops are dealt first.

    Each begins with its shortest loops: others call them and then find them in the cache. All
    versions of a loop, for other types of arguments, are in one share.
    """
    versions: dict[str, list[dict[str, Any]]] = {}
    for entry in entries:
        versions.setdefault(entry["loop"], []).append(entry)
    shares: list[list[dict[str, Any]]] = [[] for _ in range(min(count, len(versions)))]
    spent = np.zeros(len(shares))
    for same in sorted(versions.values(), key=lambda same: -_seconds(same)):
        least = int(np.argmin(spent))
        shares[least].extend(same)
        spent[least] += _seconds(same)
    for share in shares:
        share.sort(key=lambda entry: float(entry["seconds"]))
    return [shares[k] for k in np.argsort(-spent, kind="stable")]


def _seconds(entries: Sequence[dict[str, Any]]) -> float:
    return sum(float(entry["seconds"]) for entry in entries)


def _compile(entries: list[dict[str, Any]], done: Callable[[float], None] | None = None) -> None:
    """Compile loops; one that has changed since it was listed is left to its first call.

    ``done`` is called after each, with the seconds of the list.
    """
    with _saved_in_turn(), _without_collection(), _without_entries_for_c():
        for entry in entries:
            with contextlib.suppress(NumbaError, AttributeError, ImportError, TypeError):
                loop = _named(entry["loop"])
                loop.compile(tuple(type_from_json(argument) for argument in entry["arguments"]))
            if done is not None:
                done(float(entry["seconds"]))


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """Meanwhile Python looks for no garbage: a tenth of numba's time, for about 200 MB."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextlib.contextmanager
def _saved_in_turn() -> Iterator[None]:
    """Meanwhile this process saves a loop in the cache only while no other one does.

    To save one version of a loop, numba reads the loop's index, adds the version and a file name,
    and writes the index again. Two processes that do so at once lose a version, or give two of
    them one file.
    """
    save = IndexDataCacheFile.save

    def save_in_turn(self: Any, key: Any, data: Any) -> None:
        with _alone(Path(self._cache_path)):
            save(self, key, data)  # type: ignore[no-untyped-call]

    with _replaced(IndexDataCacheFile, "save", save_in_turn):
        yield


@contextlib.contextmanager
def _without_entries_for_c() -> Iterator[None]:
    """Meanwhile numba makes no entry for callers in C: a tenth of its time, and nothing calls it.

    It would be one more copy of all that a loop inlines.
    """
    _ahead.set()
    try:
        with _replaced(Lower, "create_cfunc_wrapper", lambda self: None):
            yield
    finally:
        _ahead.clear()


@contextlib.contextmanager
def _replaced(owner: Any, name: str, other: Callable[..., Any]) -> Iterator[None]:
    """Meanwhile a class of numba's has another method."""
    own = getattr(owner, name)
    setattr(owner, name, other)
    try:
        yield
    finally:
        setattr(owner, name, own)


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Meanwhile no other process is in here for this folder; without file locks at once."""
    with open(folder / ".rendezview-lock", "ab") as file:
        with contextlib.suppress(OSError):  # a file system without locks
            lock(file.fileno(), wait=True)
        yield


if __name__ == "__main__":
    if "--beside" in sys.argv and hasattr(os, "nice"):
        os.nice(10)  # a tenth of a core that another process wants
    _compile(
        json.loads(sys.argv[-1]), partial(print, flush=True) if "--count" in sys.argv else None
    )
