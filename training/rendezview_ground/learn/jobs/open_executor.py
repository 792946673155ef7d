"""Chooses where shards run: the cores of this machine, or a Dask cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rendezview_ground.learn.jobs.cores import Cores
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor


@contextlib.contextmanager
def open_executor(
    jobs: int,
    dask: str | None = None,
    *,
    processes: bool = False,
    tell: Callable[[str], None] = print,
) -> Iterator[ShardExecutor]:
    """The cores of this machine, or the Dask cluster whose scheduler has the address ``dask``.

    Args:
        jobs: parallel jobs on this machine; a cluster has its own number.
        dask: address of a scheduler, such as ``tcp://host:8786``.
        processes: on this machine, for tasks that hold the interpreter's lock.
        tell: receives one line about the cluster, with the link to its dashboard.

    Raises:
        RendezviewError: the cluster cannot be reached or used, or Dask is not installed.
    """
    if dask is None:
        yield Cores(jobs, processes)
        return
    from rendezview_ground.learn.jobs.cluster import Cluster  # needs rendezview[dask]

    with Cluster.connect(dask) as cluster:
        tell(f"{cluster.cores} cores at {dask}, dashboard: {cluster.dashboard or 'none'}")
        yield cluster
