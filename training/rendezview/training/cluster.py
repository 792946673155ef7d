"""Shards on a Dask cluster, through joblib's own backend for it.

Dask computes anew what a worker had in hand when it died. What is added here: everything shared
is moved to each worker once (unless Dask's memory manager takes it from one that waits), a failure
is told and not waited for, data that died with the last worker holding it is sent again, and a
worker with other code or packages is refused, so that the results are those of one machine, byte
for byte.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import hashlib
import logging
import os
import platform
import warnings
from collections.abc import Callable, Generator, Sequence
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import rendezview
from rendezview.errors import RendezviewError
from rendezview.training.workers import ClusterError, Shared, Task, compute, parallel

try:
    import distributed
    from joblib._dask import DaskDistributedBackend
except ModuleNotFoundError as error:
    raise RendezviewError(
        f"a cluster needs {error.name}, which is not installed: pip install 'rendezview[dask]'"
    ) from None

# What decides the bytes of a result. All parts of a cluster must have the same.
_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "numba", "scikit-learn", "trimesh")
_MESSAGES = ("dask", "distributed", "cloudpickle")  # what the parts of a cluster talk with
_TIMES_LOST = 3  # without a shard done between: then the cluster is not what it should be

Installed = dict[str, str]


@functools.cache
def installed() -> Installed:
    """Versions of what computes here, and a digest of this project's own code."""
    versions = {name: metadata.version(name) for name in (*_PACKAGES, *_MESSAGES)}
    versions["Python"] = platform.python_version()
    digest = hashlib.sha256()
    for root in sorted(map(Path, rendezview.__path__), key=lambda path: path.parent.name):
        for source in sorted(root.rglob("*.py")):
            digest.update(source.relative_to(root).as_posix().encode())
            digest.update(source.read_bytes())
    versions["rendezview's code"] = digest.hexdigest()[:12]
    return versions


class Cluster:
    """A connection to the scheduler of a Dask cluster; a context that closes it."""

    def __init__(self, client: distributed.Client, address: str) -> None:
        self._client = client
        self._address = address

    @classmethod
    def connect(cls, address: str, timeout_s: float = 10.0) -> Cluster:
        """Connect, wait for a worker, and compare all parts with this machine.

        Args:
            address: of the scheduler, such as ``tcp://host:8786``.
            timeout_s: for the scheduler to answer, and for a first worker to come.

        Raises:
            ClusterError: no scheduler or no worker there, or other versions than here.
        """
        for name in ("distributed", *_TALKATIVE):  # what goes wrong is an error here, in words
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
        """Link to the page on which Dask shows what the cluster does, if it has one."""
        services = self._client.scheduler_info(n_workers=0)["services"]
        return str(self._client.dashboard_link) if "dashboard" in services else None

    @property
    def cores(self) -> int:
        """Shards that the workers compute at a time."""
        return sum(self._client.ncores().values())

    def close(self) -> None:
        """Leave the cluster; it goes on without us."""
        self._client.close(timeout=2)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def results(
        self, task: Task, shared: Shared, arguments: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """See ``Workers``.

        Raises:
            ClusterError: the scheduler is gone, or a shard kills the workers it is given to.
        """
        left = dict(enumerate(arguments))
        lost = 0
        while left:
            numbers = list(left)
            try:
                backend = _Backend(self._client, shared)
                own = [left[k] for k in numbers]
                runs = parallel(backend, -1, _compared, (task, installed()), shared, own)
                with contextlib.closing(runs):
                    for k, result in runs:
                        if isinstance(result, _Failed):
                            raise result
                        lost = 0
                        del left[numbers[k]]
                        yield numbers[k], result
            except _Failed as failed:
                raise failed.error from None
            except distributed.KilledWorker as error:
                raise ClusterError(
                    f"{self._address}: a worker died {error.allowed_failures + 1} times at the "
                    f"same work, the last at {error.last_worker.address}: does it have too little "
                    "memory? What is done is kept"
                ) from None
            except _LOST as error:
                lost += 1
                gone = self._client.status != "running"
                if gone or lost > _TIMES_LOST:
                    what = "is gone" if gone else "gives no results"
                    raise ClusterError(
                        f"{self._address}: the cluster {what} ({_reason(error)}): start it anew "
                        "and give the same command again, what is done is kept"
                    ) from None

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
                    "'rendezview[training,dask]' there, the version that is here"
                )
            _compare(versions, installed(), worker)


async def _greet(address: str, timeout_s: float) -> None:
    """Connect and leave: a client would wait forever for what listens and says nothing."""
    if "://" in address and address.partition("://")[0] not in distributed.comm.registry.backends:
        raise ValueError("no such kind of address")
    security = distributed.Security().get_connection_args("client")
    comm = await asyncio.wait_for(
        distributed.core.connect(address, timeout=timeout_s, **security), timeout_s + 1.0
    )
    await comm.close()


_TALKATIVE = tuple(
    f"distributed.{part}" for part in ("client", "core", "scheduler", "worker", "comm", "batched")
)
# What a scheduler that goes away, or data that died with a worker, is seen as.
_LOST = (
    asyncio.CancelledError,
    concurrent.futures.CancelledError,
    distributed.client.FutureCancelledError,
    distributed.comm.CommClosedError,
    OSError,
    TimeoutError,
    RuntimeError,
)


class _Failed(Exception):
    """What a task raised, apart from what may befall a cluster."""

    @property
    def error(self) -> Exception:
        cause: Exception = self.args[0]
        return cause


class _Backend(DaskDistributedBackend):  # type: ignore[misc]
    """joblib's backend, which moves shared data to all workers first and passes failures on."""

    def __init__(self, client: distributed.Client, shared: Shared) -> None:
        super().__init__(client=client)
        self._scatter = [shared]  # joblib finds what was sent by its identity
        # By content Dask would mix up data that is being forgotten with the same sent again.
        (sent,) = client.scatter(self._scatter, broadcast=True, hash=False)
        self.data_futures = {id(shared): sent}

    def effective_n_jobs(self, n_jobs: int) -> int:
        """At least two: for one joblib would not ask the cluster, but compute here."""
        return max(2, int(super().effective_n_jobs(n_jobs)))

    def submit(
        self, func: Any, callback: Callable[[Any], None] | None = None
    ) -> concurrent.futures.Future[Any]:
        """As joblib's, which does not call back where Dask gives up a task, and waits forever."""
        future: concurrent.futures.Future[Any] = super().submit(func, callback)

        def pass_on(done: concurrent.futures.Future[Any]) -> None:
            failure = done.exception()
            if failure is not None and callback is not None:
                callback(failure)

        future.add_done_callback(pass_on)
        return future


def _compared(
    task: tuple[Task, Installed], k: int, shared: Shared, own: tuple[Any, ...]
) -> tuple[int, Any]:
    """One shard, on a worker that may have joined only now."""
    function, versions = task
    try:
        _compare(installed(), versions, f"{platform.node()}, process {os.getpid()},")
        return compute(function, k, shared, own)
    except Exception as error:
        return k, _Failed(error)


def _compare(there: Installed, here: Installed, worker: str) -> None:
    different = [
        f"{name} {there.get(name)} there, {here.get(name)} here"
        for name in sorted({*there, *here})
        if there.get(name) != here.get(name)
    ]
    if different:
        raise ClusterError(
            f"worker {worker} has other versions, and would give other results: "
            f"{'; '.join(different)}"
        )


def _reason(error: object) -> str:
    """The first line of what an error says, or its kind."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
