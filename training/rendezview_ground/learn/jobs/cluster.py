"""Shards on a Dask cluster.

Dask computes a shard again when its worker dies. This module adds:

- Shared data is sent to each worker once, and sent again when the last worker that holds it dies.
- Failures are reported at once.
- Workers with other code or packages are refused, so the bytes are those of one machine.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import os
import platform
import warnings
from collections.abc import Generator, Mapping, Sequence
from typing import Any, Self

from rendezview.errors import optional
from rendezview_ground.learn.jobs.installed import Installed, check_versions, installed
from rendezview_ground.learn.jobs.shard_executor import ClusterError, Shared, Task, run_shard

with optional("a cluster needs", "dask", ", which is not installed"):
    import distributed

_MOST_LOSSES = 3  # losses of shared data in a row, with no shard finished between them

# Dask logs on these; errors are reported in one line instead.
_LOGGERS = tuple(
    f"distributed.{part}" for part in ("client", "core", "scheduler", "worker", "comm", "batched")
)
# Errors when the scheduler stops, or when data is lost together with a worker.
_LOST = (
    asyncio.CancelledError,
    concurrent.futures.CancelledError,
    OSError,
    TimeoutError,
    RuntimeError,
)


class Cluster:
    """A connection to the scheduler of a Dask cluster; a context manager that closes it."""

    def __init__(self, client: distributed.Client, address: str) -> None:
        self._client = client
        self._address = address

    @classmethod
    def connect(cls, address: str, timeout_s: float = 10.0) -> Cluster:
        """Connect, wait for a worker, and compare all workers with this machine.

        Args:
            address: of the scheduler, such as ``tcp://host:8786``.
            timeout_s: for the scheduler to answer, and for a first worker to join.

        Raises:
            ClusterError: there is no scheduler or no worker, or the versions differ from here.
        """
        for name in ("distributed", *_LOGGERS):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # versions are compared below
                asyncio.run(_greet(address, timeout_s))
                client = distributed.Client(address, timeout=timeout_s, set_as_default=False)
        except (OSError, ValueError, TypeError, TimeoutError, RuntimeError) as error:
            raise ClusterError(
                f"{address}: no Dask scheduler answers there ({_reason(error)}): give the "
                "address that `dask scheduler` prints, such as tcp://host:8786"
            ) from None
        cluster = cls(client, address)
        try:
            cluster._wait_and_compare(timeout_s)
        except BaseException:
            cluster.close()
            raise
        return cluster

    @property
    def dashboard(self) -> str | None:
        """Link to Dask's page about the cluster, if it has one."""
        services = self._client.scheduler_info(n_workers=0)["services"]
        return str(self._client.dashboard_link) if "dashboard" in services else None

    @property
    def cores(self) -> int:
        """Shards that the workers compute at the same time."""
        return sum(self._client.ncores().values())

    def close(self) -> None:
        """Leave the cluster, which keeps running."""
        self._client.close(timeout=2)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def results(
        self, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """See ``ShardExecutor``.

        Raises:
            ClusterError: the scheduler stopped, or a shard kills its workers.
        """
        left = dict(enumerate(arguments))
        losses = 0
        while left:
            try:
                with contextlib.closing(self._completed(task, shared, left)) as completed:
                    for k, future in completed:
                        if future.status == "error":
                            break
                        result = future.result()
                        losses = 0
                        del left[k]
                        yield k, result
                    else:
                        return
            except _LOST as error:
                losses += 1
                gone = self._client.status != "running"
                if gone or losses > _MOST_LOSSES:
                    what = "is gone" if gone else "gives no results"
                    raise ClusterError(
                        f"{self._address}: the cluster {what} ({_reason(error)}): start it again "
                        "and repeat the command; finished work is kept"
                    ) from None
            else:
                raise self._failure(future.exception()) from None

    def _completed(
        self, task: Task, shared: Shared, left: Mapping[int, tuple[Any, ...]]
    ) -> Generator[tuple[int, distributed.Future], None, None]:
        """Send the shared data, submit the shards, and yield each number and future when done."""
        client, versions = self._client, installed()
        # With hash=True Dask confuses data that it is forgetting with the same data sent again.
        (sent,) = client.scatter([shared], broadcast=True, hash=False)
        numbers = {
            client.submit(_run_checked, task, versions, sent, own, pure=False): k
            for k, own in left.items()
        }
        try:
            for future in distributed.as_completed(list(numbers), loop=client.loop):
                yield numbers.pop(future), future
        finally:
            if numbers and client.status == "running":
                with contextlib.suppress(*_LOST):
                    client.cancel(list(numbers))

    def _failure(self, error: BaseException | None) -> BaseException:
        """The error of a failed shard, in the words of this project if a worker died."""
        if isinstance(error, distributed.KilledWorker):
            return ClusterError(
                f"{self._address}: a worker died {error.allowed_failures + 1} times at the "
                f"same work, the last at {error.last_worker.address}: does it have too little "
                "memory? Finished work is kept"
            )
        return error or ClusterError(f"{self._address}: a shard failed without an error")

    def _wait_and_compare(self, timeout_s: float) -> None:
        try:
            self._client.wait_for_workers(1, timeout=timeout_s)
            there = self._client.run(installed, on_error="return")
        except (TimeoutError, OSError) as error:
            raise ClusterError(
                f"{self._address}: no worker has joined this scheduler ({_reason(error)}): "
                f"start some with `dask worker {self._address}`"
            ) from None
        for worker, versions in there.items():
            if not isinstance(versions, dict):
                raise ClusterError(
                    f"worker {worker} cannot run rendezview ({_reason(versions)}): install "
                    "'rendezview[training,dask]' there, in the same version as here"
                )
            check_versions(versions, installed(), worker)


async def _greet(address: str, timeout_s: float) -> None:
    """Ask the scheduler who it is: a client would wait forever for a server that never answers."""
    security = distributed.Security().get_connection_args("client")
    async with distributed.rpc(address, timeout=timeout_s, connection_args=security) as scheduler:
        await asyncio.wait_for(scheduler.identity(n_workers=0), timeout_s + 1.0)


def _run_checked(task: Task, versions: Installed, shared: Shared, own: tuple[Any, ...]) -> Any:
    """Run one shard on a worker, which may have joined after the first comparison."""
    check_versions(installed(), versions, f"{platform.node()}, process {os.getpid()},")
    return run_shard(task, shared, own)


def _reason(error: object) -> str:
    """The first line of an error's message, or its type."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
