"""Training and campaigns on several workers: speed and bytes of docs/scale-out.md."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import distributed

from experiments.frame import mesh_of
from rendezview import TrainingOptions, ViewModel
from rendezview_ground.evaluate.assessment import AssessmentOptions, assess
from rendezview_ground.learn.job import train
from rendezview_ground.learn.jobs.cluster import Cluster
from rendezview_ground.learn.jobs.cores import Cores
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.command import default_camera

WORKERS, TARGET = 4, "hubble"
LOCAL = {"threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "silence_logs": 50,
         "host": "127.0.0.1"}  # fmt: skip
MEDIUM = TrainingOptions(order=2, perturbed_views=1600, held_out_views=400, contour_radii=(1.0,))
TINY = replace(MEDIUM, order=0, perturbed_views=60, held_out_views=20)


def written(write: Callable[[Path], object]) -> bytes:
    """The bytes of the file that a work writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "written"
        write(path)
        return path.read_bytes()


def training(mesh: Mesh, options: TrainingOptions, executor: ShardExecutor) -> bytes:
    return written(lambda p: train(mesh, p, name="target", options=options, executor=executor))


def campaign(model: ViewModel, mesh: Mesh, frames: int, executor: ShardExecutor) -> bytes:
    options = AssessmentOptions(frames=frames, seed=9)
    return written(lambda p: assess(model, mesh, default_camera(), p, executor, options))


def load_code(mesh: Mesh, model: ViewModel) -> None:
    training(mesh, TINY, Cores(1))
    campaign(model, mesh, 4, Cores(1))


def run(*, model: Path, frames: Annotated[int, "of the campaign"] = 192) -> None:
    """Training and a campaign of hubble, with its MODEL, on one worker and on four.

    Starts a scheduler and workers of one thread each on this machine, lets every worker load its
    compiled code, and times the same training and the same campaign. Efficiency is the time of one
    worker over the time of several, over the number of cores. The bytes must be the same without a
    cluster.
    """
    (_, mesh), loaded = mesh_of(TARGET), ViewModel.load(model)
    works = {
        "training": lambda w: training(mesh, MEDIUM, w),
        "campaign": lambda w: campaign(loaded, mesh, frames, w),
    }
    cores = os.cpu_count() or 1
    wall: dict[tuple[str, int], float] = {}
    results: dict[str, set[bytes]] = {name: set() for name in works}
    for count in (1, WORKERS):
        with (
            distributed.LocalCluster(n_workers=count, **LOCAL) as local,
            Cluster.connect(local.scheduler_address) as cluster,
        ):
            with distributed.Client(local.scheduler_address, set_as_default=False) as client:
                client.run(load_code, mesh, loaded)  # in every worker
            for name, work in works.items():
                start = time.perf_counter()
                results[name].add(work(cluster))
                wall[name, count] = time.perf_counter() - start
                print(f"{name}, {count} workers: {wall[name, count]:.1f} s", flush=True)
    for name, work in works.items():
        results[name].add(work(Cores(-1, processes=name == "campaign")))
        ratio = wall[name, 1] / wall[name, WORKERS]
        print(
            f"{name}: {ratio:.2f} × as fast on {cores} cores, {ratio / cores:.2f} of the cores; "
            f"bytes of one worker, {WORKERS} workers "
            f"and no cluster {'identical' if len(results[name]) == 1 else 'DIFFERENT'}"
        )
