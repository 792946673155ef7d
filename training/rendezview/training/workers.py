"""Where shards are computed: the cores of this machine, or a Dask cluster.

Both go through one ``joblib.Parallel``; only its backend differs. A task is a function of a
module, so that other processes find it, and gets what all shards share and then its own arguments.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import sys
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import joblib

from rendezview.errors import RendezviewError


class ClusterError(RendezviewError):
    """Something about a cluster, and not about what it was given to do."""


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_KEPT_BYTES = 256 << 20  # of what is free, at most, in each process
_LARGEST_KEPT_BYTES = 32 << 20  # of one block; glibc allows no more

Task = Callable[..., Any]
Shared = tuple[Any, ...]


class Workers(Protocol):
    """Computes shards, in any order."""

    def results(
        self, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """``(k, task(*shared, *arguments[k]))`` as each is done; to be closed where left early.

        Args:
            task: of a module; what it returns depends on its arguments alone.
            shared: moved once to each machine. Not to be changed by the task.
            arguments: small; they travel with their shard.

        Raises:
            Exception: what a task raises. The others are abandoned.
        """


@dataclass(frozen=True, slots=True)
class Cores:
    """The cores of this machine."""

    jobs: int = -1  # as joblib counts: −1 for all cores
    processes: bool = False  # for tasks that hold the interpreter's lock

    def __post_init__(self) -> None:
        if self.jobs == 0:
            raise RendezviewError("jobs = 0: give the number of parallel jobs, or -1 for all cores")

    def results(
        self, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """See ``Workers``."""
        threads = cv2.getNumThreads()
        try:
            if self.processes:
                yield from parallel("loky", self.jobs, compute, task, shared, arguments)
            else:
                yield from _in_threads(self.jobs, task, shared, arguments)
        finally:
            cv2.setNumThreads(threads)


@contextlib.contextmanager
def open_workers(
    jobs: int,
    dask: str | None = None,
    *,
    processes: bool = False,
    tell: Callable[[str], None] = print,
) -> Iterator[Workers]:
    """The cores of this machine, or of the Dask cluster whose scheduler has this address.

    Args:
        jobs: at a time on this machine; a cluster has its own number.
        processes: on this machine, for tasks that hold the interpreter's lock.
        tell: gets a line about the cluster, with the link to its dashboard.

    Raises:
        RendezviewError: the cluster cannot be reached or used, or Dask is not installed.
    """
    if dask is None:
        yield Cores(jobs, processes)
        return
    from rendezview.training.cluster import Cluster

    with Cluster.connect(dask) as cluster:
        tell(f"{cluster.cores} cores at {dask}, dashboard: {cluster.dashboard or 'none'}")
        yield cluster


def parallel(
    backend: Any,
    jobs: int,
    runner: Callable[..., Any],
    task: Any,
    shared: Shared,
    arguments: Sequence[tuple[Any, ...]],
) -> Generator[tuple[int, Any], None, None]:
    """The one way to compute shards: ``runner(task, k, shared, arguments[k])`` on a backend."""
    workers = joblib.Parallel(
        n_jobs=jobs,
        backend=backend,
        batch_size=1,  # a shard that is lost takes no other with it
        return_as="generator_unordered",  # each is kept as soon as it is done
    )
    calls = (joblib.delayed(runner)(task, k, shared, own) for k, own in enumerate(arguments))
    results = workers(calls)
    try:
        for result in results:  # noqa: UP028  closed below, and not by `yield from`
            yield result
    finally:  # stops what waits where one fails
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it was stopped
            results.close()


def _in_threads(
    jobs: int, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
) -> Generator[tuple[int, Any], None, None]:
    """As ``parallel``, and no thread is left in a shard.

    joblib abandons what runs when it is stopped. A thread that the end of the interpreter then
    meets within compiled C++ aborts the process.
    """
    at_work, idle = 0, threading.Condition()

    def computed(*shard: Any) -> tuple[int, Any]:
        nonlocal at_work
        with idle:
            at_work += 1
        try:
            return compute(*shard)
        finally:
            with idle:
                at_work -= 1
                idle.notify_all()

    try:
        yield from parallel("threading", jobs, computed, task, shared, arguments)
    finally:
        with idle:
            idle.wait_for(lambda: at_work == 0)


def compute(task: Task, k: int, shared: Shared, own: tuple[Any, ...]) -> tuple[int, Any]:
    """One shard, and which."""
    cv2.setNumThreads(1)  # the shards are the parallelism
    _keep_freed_memory()
    return k, task(*shared, *own)


@functools.cache
def _keep_freed_memory() -> None:
    """Let glibc keep for the next picture what the last one needed.

    Pages that go back to the system come again as faults: an eighth to a third of the time of
    drawing on a Dask worker, which is told to keep nothing, and a sixth of contours elsewhere.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # not every Linux is of glibc
        if mallopt is not None:
            mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
            mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT_BYTES)
