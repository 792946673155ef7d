"""Shards on the cores of this machine, in threads or in processes."""

from __future__ import annotations

import warnings
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
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
                else:
                    run = _in_processes if self.processes else _in_threads
                    yield from run(jobs, task, shared, arguments)
        finally:
            cv2.setNumThreads(threads)


def _in_threads(
    jobs: int, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
) -> Generator[tuple[int, Any], None, None]:
    """Run shards in threads, and wait for all running threads before returning.

    A thread that is still inside compiled C++ when the interpreter ends would abort the process.
    """
    pool = ThreadPoolExecutor(jobs)
    try:
        number = {pool.submit(run_shard, task, shared, own): k for k, own in enumerate(arguments)}
        for done in as_completed(list(number)):
            yield number.pop(done), done.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _in_processes(
    jobs: int, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
) -> Generator[tuple[int, Any], None, None]:
    """Run shards under joblib, in processes."""
    parallel = joblib.Parallel(
        n_jobs=jobs,
        backend="loky",
        batch_size=1,  # a lost shard takes no other with it
        return_as="generator_unordered",  # each result is kept as soon as it is ready
    )
    results = parallel(
        joblib.delayed(_numbered)(k, task, shared, own) for k, own in enumerate(arguments)
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
