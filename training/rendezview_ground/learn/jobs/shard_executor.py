"""Shared parts of all executors of shards: the contract, its types, and how one shard runs.

A shard is a part of a stage of work: a task and its arguments. A task is a function of a module,
so that other processes find it.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable, Generator, Sequence
from typing import Any, Protocol

import cv2

from rendezview.errors import RendezviewError

Task = Callable[..., Any]
Shared = tuple[Any, ...]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # Source: glibc, malloc.h
_KEPT_BYTES = 256 << 20  # bytes; freed memory that each process keeps, at most
_LARGEST_KEPT_BYTES = 32 << 20  # bytes of one block. Source: largest value that glibc allows


class ClusterError(RendezviewError):
    """The cluster fails, not the task it was given."""


class ShardExecutor(Protocol):
    """Computes shards, in any order."""

    def results(
        self, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """Yield ``(k, task(*shared, *arguments[k]))`` as each shard finishes.

        Close the generator to stop early.

        Args:
            task: a function of a module; its result depends on its arguments only.
            shared: the same for all shards, moved once to each machine. Tasks must not change it.
            arguments: of each shard; small, because they travel with it.

        Raises:
            Exception: a task raised it. The remaining shards are cancelled.
        """


def run_shard(task: Task, shared: Shared, own: tuple[Any, ...]) -> Any:
    """Run one shard in this thread."""
    cv2.setNumThreads(1)  # the shards are the parallelism
    _keep_freed_memory()
    return task(*shared, *own)


@functools.cache
def _keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next picture.

    Pages that return to the system cost page faults when they are needed again: an eighth to a
    third of the drawing time on a Dask worker, which Dask configures to keep nothing, and a sixth
    of the contour time elsewhere.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # absent without glibc
        if mallopt is not None:
            mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
            mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT_BYTES)
