"""Shards on a Dask cluster of several processes: the bytes of one machine, whatever dies."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from tests.processes import python
from tests.quick_training import EVERY_STAGE, FEW_STAGES
from tests.waiting import MOST_S, wait_until

from rendezview.cli.main import main
from rendezview.errors import RendezviewError
from rendezview_ground.evaluate.assessment import AssessmentOptions, assess
from rendezview_ground.learn.job import train
from rendezview_ground.learn.jobs.cores import Cores
from rendezview_ground.learn.jobs.installed import installed
from rendezview_ground.learn.jobs.open_executor import open_executor

distributed = pytest.importorskip("distributed", reason="rendezview[dask] is not installed")

from rendezview_ground.learn.jobs import cluster  # noqa: E402


@dataclass
class Processes:
    """A scheduler and workers, each a process of its own."""

    address: str
    scheduler: subprocess.Popen[str]
    workers: list[subprocess.Popen[str]]


@contextmanager
def processes(
    folder: Path, workers: int, allowed_failures: int = 3, nanny: bool = False
) -> Iterator[Processes]:
    """As a user starts them; without a nanny a worker that dies stays dead."""
    environment = dict(
        os.environ,
        OMP_NUM_THREADS="1",
        DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES=str(allowed_failures),
        # Every other second it takes copies from workers that happen to wait for a shard.
        DASK_DISTRIBUTED__SCHEDULER__ACTIVE_MEMORY_MANAGER__START="false",
    )
    place = folder / "scheduler.json"
    with ExitStack() as started:

        def start(*arguments: object) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *map(str, arguments)],
                env=environment,
                cwd=folder,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                text=True,
                start_new_session=True,  # a nanny's worker ends with it
            )
            started.callback(process.wait)
            started.callback(_kill_group, process.pid)
            return process

        scheduler = start(
            "scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard",
            "--scheduler-file", place,
        )  # fmt: skip
        joined = [
            start(
                "worker", "--scheduler-file", place, "--nthreads", 1,
                "--nanny" if nanny else "--no-nanny",
                "--no-dashboard", "--host", "127.0.0.1", "--local-directory", folder,
                "--death-timeout", MOST_S,
            )
            for _ in range(workers)
        ]  # fmt: skip
        address = _address(place)
        if workers:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=MOST_S)
        yield Processes(address, scheduler, joined)


def _kill_group(leader: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)


def _address(place: Path) -> str:
    """The scheduler's address from its file, which stands there a moment before it is written."""

    def address() -> str | None:
        with suppress(FileNotFoundError, json.JSONDecodeError):
            return json.loads(place.read_text())["address"]
        return None

    return wait_until(address)


@pytest.fixture(scope="module")
def several(tmp_path_factory) -> Iterator[Processes]:
    with processes(tmp_path_factory.mktemp("several"), 2, allowed_failures=1) as started:
        yield started


def double(offset: int, k: int, log: Path, sleep_s: float) -> int:
    with log.open("a") as file:
        file.write(f"{k} {os.getpid()}\n")
    time.sleep(sleep_s)
    return offset + 2 * k


def _computed(log: Path) -> list[tuple[int, int]]:
    """Each shard that was begun, and the process."""
    lines = [line.split() for line in log.read_text().splitlines()]
    return [(int(k), int(pid)) for k, pid in lines]


def deadly(k: int, once: Path | None) -> int:
    if k == 3 and not (once is not None and once.exists()):
        if once is not None:
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return k


def wrong(k: int) -> int:
    raise OSError(f"shard {k} has no file")


def address_of(array: np.ndarray, k: int, met: Path, workers: int) -> tuple[int, int]:
    """Process and place of the array; waits until so many workers compute one."""
    (met / str(os.getpid())).touch()
    while len(list(met.iterdir())) < workers:
        time.sleep(0.01)
    return os.getpid(), array.ctypes.data


# Workers cannot import the test modules: functions without a module travel with their code.
for task in (double, deadly, wrong, address_of):
    task.__module__ = "__main__"


def test_a_cluster_gives_the_bytes_of_one_machine(tmp_path, bumpy_mesh, several, every_stage):
    with open_executor(-1, several.address, tell=lambda line: None) as executor:
        train(bumpy_mesh, tmp_path / "m.rvm", name="bumpy", options=EVERY_STAGE, executor=executor)
    assert (tmp_path / "m.rvm").read_bytes() == every_stage


def test_a_campaign_on_a_cluster_gives_the_bytes_of_one_machine(
    tmp_path, bumpy_mesh, camera, several, refining_model
):
    options = AssessmentOptions(frames=20, samples=1)
    shared = (refining_model, bumpy_mesh, camera)
    assess(*shared, tmp_path / "here", Cores(1), options)
    with cluster.Cluster.connect(several.address) as executor:
        assess(*shared, tmp_path / "there", executor, options)
    assert (tmp_path / "there").read_bytes() == (tmp_path / "here").read_bytes()


def test_what_a_shard_raises_is_raised_here(several):
    with (
        cluster.Cluster.connect(several.address) as executor,
        pytest.raises(OSError, match="has no file"),
    ):
        list(executor.results(wrong, (), [(k,) for k in range(4)]))


def test_large_shared_data_is_moved_once_to_each_worker(several, tmp_path):
    shared = (np.zeros(2_000_000),)
    with cluster.Cluster.connect(several.address) as executor:
        arguments = [(k, tmp_path, 2) for k in range(40)]
        seen = [s for _, s in executor.results(address_of, shared, arguments)]
    places = {(pid, place) for pid, place in seen}
    assert len({pid for pid, _ in places}) == 2
    assert len(places) == len({pid for pid, _ in places})  # one copy in each process


def test_a_killed_worker_costs_only_its_shard(tmp_path, bumpy_mesh, few_stages):
    log = tmp_path / "log"
    with processes(tmp_path, 3) as started, cluster.Cluster.connect(started.address) as executor:
        assert executor.cores == 3
        results: dict[int, int] = {}
        killed, handed_over = -1, set[int]()
        arguments = [(k, log, 0.1) for k in range(24)]
        for k, result in executor.results(double, (7,), arguments):
            results[k] = result
            if len(results) == 5:
                killed, handed_over = _computed(log)[-1][1], set(results)
                os.kill(killed, signal.SIGKILL)
        assert results == {k: 7 + 2 * k for k in range(24)}
        again = _computed(log)
        for k in range(24):
            again.remove(next(line for line in reversed(again) if line[0] == k))
        # Shards that it had begun, or done but not handed over yet: no others are computed twice.
        assert {pid for _, pid in again} <= {killed}
        assert not {k for k, _ in again} & handed_over

        def kill(stage: str, done: int, of: int) -> None:
            if stage == "contours" and done == 1:
                next(w for w in started.workers if w.pid != killed).kill()

        train(
            bumpy_mesh,
            tmp_path / "m.rvm",
            name="bumpy",
            options=FEW_STAGES,
            executor=executor,
            progress=kill,
        )
        wait_until(lambda: executor.cores == 1)
    assert (tmp_path / "m.rvm").read_bytes() == few_stages


def test_a_shard_that_kills_its_workers_is_told_and_not_waited_for(tmp_path):
    with (
        processes(tmp_path, 3, allowed_failures=1) as started,
        cluster.Cluster.connect(started.address) as executor,
        pytest.raises(RendezviewError, match="died 2 times"),
    ):
        list(executor.results(deadly, (), [(k, None) for k in range(8)]))


def test_one_worker_alone_computes_and_data_that_died_with_it_is_sent_again(tmp_path):
    """And not the process of the command."""
    (tmp_path / "met").mkdir()
    with (
        processes(tmp_path, 1, nanny=True) as started,  # which starts another worker
        cluster.Cluster.connect(started.address) as executor,
    ):
        met = [(k, tmp_path / "met", 1) for k in range(3)]
        seen = list(executor.results(address_of, (np.zeros(4),), met))
        assert os.getpid() not in {pid for _, (pid, _) in seen}
        arguments = [(k, tmp_path / "once") for k in range(8)]
        assert dict(executor.results(deadly, (), arguments)) == {k: k for k in range(8)}
    assert (tmp_path / "once").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_what_one_shard_frees_serves_the_next_where_dask_would_give_it_back(tmp_path):
    faults = """
import resource
import numpy
from rendezview_ground.learn.jobs.shard_executor import run_shard
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def task():
    return [float(numpy.ones(500_000)[0]) for _ in range(20)][0]
run_shard(task, (), ())
before = faults()
run_shard(task, (), ())
print(faults() - before)
"""
    environment = dict(os.environ, MALLOC_TRIM_THRESHOLD_="65536")  # as Dask's nannies set it
    assert int(python("-c", faults, env=environment).stdout) < 2000  # of 20,000 pages


def test_a_scheduler_that_is_gone_is_told_and_what_was_done_is_kept(
    tmp_path, bumpy_mesh, few_stages
):
    path, first = tmp_path / "m.rvm", {}
    with processes(tmp_path, 1) as started:

        def kill(stage: str, done: int, of: int) -> None:
            if stage == "contours" and done == 1:
                started.scheduler.kill()

        with (
            cluster.Cluster.connect(started.address) as executor,
            pytest.raises(RendezviewError, match=r"is gone.*finished work is kept"),
        ):
            train(
                bumpy_mesh, path, name="bumpy", options=FEW_STAGES, executor=executor, progress=kill
            )
    train(
        bumpy_mesh,
        path,
        name="bumpy",
        options=FEW_STAGES,
        executor=Cores(1),
        progress=lambda stage, done, of: first.setdefault(stage, (done, of)),
    )
    assert first["views"] == (5, 5)
    assert first["contours"][0] >= 1
    assert path.read_bytes() == few_stages


def test_an_address_without_a_scheduler_is_refused():
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        deaf = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        for address in (deaf, "tcp://127.0.0.1:1", "nothing at all", "ftp://x:1", ""):
            with pytest.raises(RendezviewError, match="no Dask scheduler answers"):
                cluster.Cluster.connect(address, timeout_s=1.0)


@pytest.mark.parametrize("is_installed", [True, False])
def test_the_command_says_in_one_line_why_there_is_no_cluster(
    tmp_path, monkeypatch, capsys, is_installed
):
    if not is_installed:
        monkeypatch.setitem(sys.modules, "distributed", None)
        monkeypatch.delitem(sys.modules, cluster.__name__)
    # Refused at once; a port where nobody listens is tried for ten seconds.
    command = ["train", "scole", "-o", str(tmp_path / "m.rvm"), "--dask", "ftp://x:1"]
    monkeypatch.setattr(sys, "argv", ["rendezview", *command])
    with pytest.raises(SystemExit, match="1"):
        main()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("rendezview: ")
    assert ("no Dask scheduler answers" if is_installed else "[dask]'") in said
    assert list(tmp_path.iterdir()) == []


def test_a_scheduler_without_workers_is_refused(tmp_path, monkeypatch):
    """Its own answer may take long, but a worker is not waited for."""
    wait = distributed.Client.wait_for_workers
    monkeypatch.setattr(
        distributed.Client, "wait_for_workers", lambda self, count, timeout: wait(self, count, 0.1)
    )
    with (
        processes(tmp_path, 0) as started,
        pytest.raises(RendezviewError, match="no worker has joined"),
    ):
        cluster.Cluster.connect(started.address, timeout_s=MOST_S)


def test_workers_with_other_versions_are_refused_by_name(several, monkeypatch):
    original: Callable[[str], str] = metadata.version
    monkeypatch.setattr(metadata, "version", lambda p: "9.9" if p == "numpy" else original(p))
    installed.cache_clear()
    try:
        with pytest.raises(RendezviewError, match=r"worker tcp\S+ has other.*numpy .* 9\.9 here"):
            cluster.Cluster.connect(several.address)
    finally:
        installed.cache_clear()
