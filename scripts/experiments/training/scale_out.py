"""Training and campaigns on several workers: speed, bytes, kills and costs of docs/scale-out.md."""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import dask
import distributed
import psutil
from rendezview.evaluation.campaign import CampaignOptions, campaign
from rendezview.simulation.command import default_camera
from rendezview.training.cluster import Cluster
from rendezview.training.cores import Cores
from rendezview.training.job import train
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions
from rendezview.training.shard_executor import ShardExecutor
from rendezview.training.surface_points import SURFACE_ORDER

from experiments.frame import mesh_of
from experiments.training.speed import split
from rendezview.geometry.geodesic import Geodesic
from rendezview.sensors.appearance import ViewModel

MEDIUM = TrainingOptions(order=2, perturbed_views=1600, held_out_views=400, contour_radii=(1.0,))
SMALL = replace(MEDIUM, order=1, perturbed_views=1200, held_out_views=200)
TINY = replace(SMALL, order=0, perturbed_views=60, held_out_views=20)
KILLED = replace(
    SMALL,
    perturbed_views=600,
    held_out_views=20,
    bins=60,
    smooth_bins=3,
    resolution_px=64,
    contour_points=20,
    contour_resolution_px=64,
)
STAGES = {  # of training, and how often the default training does each: views or nodes
    "lattice": 2562, "perspective": 2562, "views": 32_000, "held-out": 4000,
    "contours": 3 * 2562, "shadows": 2562, "surface": 642, "trees": 642, "calibration": 4000,
}  # fmt: skip


@contextmanager
def local_cluster(workers: int) -> Iterator[tuple[distributed.LocalCluster, Cluster]]:
    with (
        # A killed worker's successor has all the time it needs on a busy machine.
        dask.config.set({"distributed.deploy.lost-worker-timeout": "300s"}),
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0",
            silence_logs=50, host="127.0.0.1",
        ) as local,
        Cluster.connect(local.scheduler_address) as cluster,
    ):  # fmt: skip
        yield local, cluster


def pids(local: distributed.LocalCluster) -> list[int]:
    with distributed.Client(local.scheduler_address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


def cpu_s(processes: list[int]) -> float:
    times = [psutil.Process(p).cpu_times() for p in processes]
    return sum(t.user + t.system for t in times)


def others_s(ours: list[int]) -> float:
    """CPU time of the machine that was not ours."""
    busy = psutil.cpu_times()
    return busy.user + busy.system + busy.nice + busy.steal - cpu_s([*ours, os.getpid()])


def run_training(mesh: Mesh, options: TrainingOptions, executor: ShardExecutor) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.rvm"
        train(mesh, path, name="target", options=options, executor=executor)
        return path.read_bytes()


def run_campaign(model: ViewModel, mesh: Mesh, frames: int, executor: ShardExecutor) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "answers.jsonl"
        options = CampaignOptions(frames=frames, seed=9)
        campaign(model, mesh, default_camera(), path, executor, options)
        return path.read_bytes()


def load_code(mesh: Mesh, model: ViewModel) -> None:
    run_training(mesh, TINY, Cores(1))
    run_campaign(model, mesh, 4, Cores(1))


def speed(target: str, model_path: Path, workers: int, frames: int) -> None:
    (_, mesh), model = mesh_of(target), ViewModel.load(model_path)
    works = {
        "training": lambda w: run_training(mesh, MEDIUM, w),
        "campaign": lambda w: run_campaign(model, mesh, frames, w),
    }
    cores = os.cpu_count() or 1
    wall: dict[tuple[str, int], float] = {}
    cpu: dict[tuple[str, int], float] = {}
    results: dict[str, set[bytes]] = {name: set() for name in works}
    print("| work | workers | wall s | CPU s of workers | of this process | others meanwhile |")
    print("|---|---:|---:|---:|---:|---:|")
    for count in (1, workers):
        with local_cluster(count) as (local, cluster):
            with distributed.Client(local.scheduler_address, set_as_default=False) as client:
                client.run(load_code, mesh, model)  # in every worker
            processes = pids(local)
            for name, work in works.items():
                spent, own, rest = cpu_s(processes), time.process_time(), others_s(processes)
                start = time.perf_counter()
                results[name].add(work(cluster))
                wall[name, count] = time.perf_counter() - start
                cpu[name, count] = cpu_s(processes) - spent
                print(
                    f"| {name} | {count} | {wall[name, count]:.1f} | {cpu[name, count]:.1f} | "
                    f"{time.process_time() - own:.1f} | {others_s(processes) - rest:.1f} |",
                    flush=True,
                )
    for name, work in works.items():
        results[name].add(work(Cores(-1, processes=name == "campaign")))
        one, many = (name, 1), (name, workers)
        ratio = wall[one] / wall[many]
        print(
            f"{name}: {ratio:.2f} × as fast on {cores} cores, {ratio / cores:.2f} of the cores; "
            f"CPU {cpu[one] / cpu[many]:.2f}; bytes of one worker, {workers} workers "
            f"and no cluster {'identical' if len(results[name]) == 1 else 'DIFFERENT'}"
        )


def kill(target: str, workers: int, runs: int, seed: int) -> None:
    _, mesh = mesh_of(target)
    expected = run_training(mesh, KILLED, Cores(-1))
    passed = 0
    with local_cluster(workers) as (local, cluster):
        for run in range(runs):
            rng = random.Random(1000 * seed + run)
            stage, after = rng.choice(["views", "contours", "shadows"]), rng.randint(1, 2)
            with distributed.Client(local.scheduler_address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=300)  # the nanny's new one
            victim = rng.choice(sorted(pids(local)))
            killed = []

            def progress(
                reported: str,
                done: int,
                of: int,
                at: tuple[str, int] = (stage, after),
                victim: int = victim,
                killed: list[int] = killed,
            ) -> None:
                if (reported, done) == at and not killed:
                    os.kill(victim, signal.SIGKILL)
                    killed.append(victim)

            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "model.rvm"
                start = time.perf_counter()
                train(
                    mesh, path, name="target", options=KILLED, executor=cluster, progress=progress
                )
                same = path.read_bytes() == expected and bool(killed)
            passed += same
            print(
                f"run {run}: worker killed after shard {after} of {stage}, "
                f"{'identical' if same else 'DIFFERENT'}, {time.perf_counter() - start:.1f} s",
                flush=True,
            )
    print(f"killed and identical: {passed} of {runs}")


def stage_cpu(mesh: Mesh, options: TrainingOptions) -> tuple[dict[str, float], float, int]:
    """CPU seconds of each stage, of all that is not in one, and the size of the model."""
    first: dict[str, float] = {}
    last: dict[str, float] = {}

    def progress(stage: str, done: int, of: int) -> None:
        first.setdefault(stage, time.process_time())
        last[stage] = time.process_time()

    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.rvm"
        train(mesh, path, name="t", options=options, jobs=1, progress=progress)
        size = path.stat().st_size
    total = time.process_time() - start
    stages = {stage: last[stage] - first[stage] for stage in first}
    return stages, total - sum(stages.values()), size


def cost(target: str, full: bool) -> None:
    _, mesh = mesh_of(target)
    stage_cpu(mesh, TINY)  # loads compiled code
    base = TrainingOptions() if full else SMALL
    cases = {f"order {base.order}, {len(mesh.faces)} triangles": (mesh, base)}
    if not full:
        cases["order 2"] = (mesh, replace(base, order=2))
        finer = split(mesh, 4 * len(mesh.faces))
        cases[f"{len(finer.faces)} triangles"] = (finer, base)
        cases["half the pixels across"] = (
            mesh,
            replace(
                base,
                resolution_px=base.resolution_px // 2,
                contour_resolution_px=base.contour_resolution_px // 2,
            ),
        )
        cases["4 × the perturbed views"] = (
            mesh,
            replace(base, perturbed_views=4 * base.perturbed_views),
        )
    print(f"| CPU s | {' | '.join(STAGES)} | rest | all | MB |")
    print("|---" * (len(STAGES) + 4) + "|")
    table = {}
    for name, (shape, options) in cases.items():
        stages, rest, size = stage_cpu(shape, options)
        table[name] = (stages, rest, options)
        cells = " | ".join(f"{stages.get(stage, 0.0):.2f}" for stage in STAGES)
        whole = sum(stages.values()) + rest
        print(f"| {name} | {cells} | {rest:.2f} | {whole:.2f} | {size / 1e6:.1f} |", flush=True)
    stages, rest, options = next(iter(table.values()))
    lattice = len(Geodesic.of_order(options.order + 1).nodes)
    nodes = len(Geodesic.of_order(options.order).nodes)
    counts = {
        "lattice": lattice, "perspective": lattice, "views": options.perturbed_views,
        "held-out": options.held_out_views, "contours": lattice * len(options.contour_radii),
        "shadows": lattice, "surface": len(Geodesic.of_order(SURFACE_ORDER).nodes), "trees": nodes,
        "calibration": options.held_out_views,
    }  # fmt: skip
    print("| stage | times in a default training | CPU ms each | CPU s |")
    print("|---|---:|---:|---:|")
    sum_s = 0.0
    for stage, often in STAGES.items():
        each = stages[stage] / counts[stage]
        if stage == "trees":  # their samples grow with the views around the node
            each *= (TrainingOptions().perturbed_views / options.perturbed_views) * (
                nodes / STAGES["trees"]
            )
        sum_s += each * often
        print(f"| {stage} | {often} | {1000 * each:.2f} | {each * often:.0f} |")
    rest_s = rest * STAGES["contours"] / counts["contours"]
    print(f"one default model: {sum_s:.0f} CPU s of workers, {rest_s:.0f} of the process that asks")
    for cores in (2, 16, 64):
        hours = max(1000 * sum_s / cores, 1000 * rest_s) / 3600
        print(f"1000 of them on {cores} cores: {hours:.1f} h")
    print(f"one process that asks keeps {sum_s / rest_s:.0f} cores at work")


def run(
    part: Literal["speed", "kill", "cost"],
    *, target: str = "hubble",
    model: Annotated[Path | None, "speed: a trained model of the target"] = None,
    workers: int = 4, frames: Annotated[int, "speed: of the campaign"] = 192,
    runs: Annotated[int, "kill"] = 10, seed: Annotated[int, "kill: which, when"] = 1,
    full: Annotated[bool, "cost: the default training itself"] = False,
) -> None:  # fmt: skip
    """Training and campaigns on several workers: speed, bytes, kills and costs.

    speed: starts a scheduler and workers of one thread each on this machine, lets every worker
    load its compiled code, and times the same training and the same campaign. Efficiency is the
    time of one worker over the time of several, over the number of cores. "CPU" is the CPU time
    of one worker over the sum of several: it counts repeated work, not waiting, so other
    load disturbs it less.
    kill: one worker is killed in the middle of a training; the bytes must be the same.
    cost: CPU time by stage, in this one process; --full trains with the defaults instead of
    extrapolating to them.
    """
    if part == "speed":
        if model is None:
            raise SystemExit("speed needs --model")
        speed(target, model, workers, frames)
    elif part == "kill":
        kill(target, workers, runs, seed)
    else:
        cost(target, full)
