"""Shards on the cores of this machine, in threads or in processes."""

from __future__ import annotations

import functools
import threading
import warnings
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import joblib
from threadpoolctl import threadpool_limits

from rendezview.errors import RendezviewError
from rendezview_ground.learn.jobs.shard_executor import Shared, Task, run_shard


@dataclass(frozen=True, slots=True)
class Cores:
    """An executor on the cores of this machine."""

    jobs: int = -1  # parallel jobs, counted as joblib does: −1 for all cores
    processes: bool = False  # for tasks that hold the interpreter's lock

    def __post_init__(self) -> None:
        if self.jobs == 0:
            raise RendezviewError("jobs = 0: give the number of parallel jobs, or -1 for all cores")

    def results(
        self, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """See ``ShardExecutor``."""
        threads = cv2.getNumThreads()
        jobs = int(joblib.effective_n_jobs(self.jobs))
        try:
            # Shards are the parallelism: threads of linear algebra would only wait for each other.
            with threadpool_limits(1):
                if jobs == 1:
                    for k, own in enumerate(arguments):
                        yield k, run_shard(task, shared, own)
                elif self.processes:
                    yield from _in_parallel("loky", jobs, _numbered, task, shared, arguments)
                else:
                    yield from _in_threads(jobs, task, shared, arguments)
        finally:
            cv2.setNumThreads(threads)


def _in_threads(
    jobs: int, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
) -> Generator[tuple[int, Any], None, None]:
    """Run shards in threads, and wait for all running threads before returning.

    A thread that is still inside compiled C++ when the interpreter ends would abort the process.
    """
    gate = _Gate()
    numbered = functools.partial(gate.passed, _numbered)
    try:
        yield from _in_parallel("threading", jobs, numbered, task, shared, arguments)
    finally:
        gate.shut()


class _Gate:
    """Counts the shards that run in threads, and lets no more begin once it is shut."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._running = 0
        self._shut = False

    def passed(self, numbered: Task, *arguments: Any) -> Any:
        """Run a shard; None if the gate is shut."""
        with self._changed:
            if self._shut:
                return None
            self._running += 1
        try:
            return numbered(*arguments)
        finally:
            with self._changed:
                self._running -= 1
                self._changed.notify_all()

    def shut(self) -> None:
        """Wait for the shards that run."""
        with self._changed:
            self._shut = True
            self._changed.wait_for(lambda: self._running == 0)


def _in_parallel(
    backend: str,
    jobs: int,
    numbered: Task,
    task: Task,
    shared: Shared,
    arguments: Sequence[tuple[Any, ...]],
) -> Generator[tuple[int, Any], None, None]:
    """Run shards under joblib, in its backend of threads or of processes."""
    parallel = joblib.Parallel(
        n_jobs=jobs,
        backend=backend,
        batch_size=1,  # a lost shard takes no other with it
        return_as="generator_unordered",  # each result is kept as soon as it is ready
    )
    results = parallel(
        joblib.delayed(numbered)(k, task, shared, own) for k, own in enumerate(arguments)
    )
    try:
        for result in results:  # noqa: UP028  closed below, and not by `yield from`
            yield result
    finally:  # cancels the waiting shards when one fails
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # joblib warns about the cancellation
            results.close()


def _numbered(k: int, task: Task, shared: Shared, own: tuple[Any, ...]) -> tuple[int, Any]:
    return k, run_shard(task, shared, own)
