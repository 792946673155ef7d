"""Ray nodes and gateways of the service as processes on this machine, to be killed."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from tests.waiting import MOST_S, ends_in_time

from rendezview.errors import RendezviewError
from rendezview_service.client import Client

_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
}
_STORE = 100_000_000  # bytes, a node's object store


class Nodes:
    """Ray nodes as processes, each with one core; the head has none."""

    def __init__(self, count: int) -> None:
        os.environ.update(_ENVIRONMENT)
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 0, "include_dashboard": False, "object_store_memory": _STORE}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes = [self.add() for _ in range(count)]

    def add(self):
        return self.cluster.add_node(num_cpus=1, object_store_memory=_STORE)

    def kill_only(self, place: int) -> None:
        """kill -9 of a node and all its processes."""
        kill_tree(self.nodes[place].all_processes["raylet"][0].process.pid)

    def kill_orchestrator(self) -> None:
        """kill -9 of the orchestrator; Ray starts it again."""
        raylet = self.cluster.head_node.all_processes["raylet"][0].process.pid
        for pid in tree(raylet):
            with contextlib.suppress(OSError):
                if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::Orchestrator"):
                    os.kill(pid, signal.SIGKILL)
                    return
        raise SystemExit("no orchestrator is found")


def tree(pid: int) -> list[int]:
    """A process and all that descend from it."""
    pids = [pid]
    for known in pids:
        with contextlib.suppress(OSError):
            tasks = Path(f"/proc/{known}/task")
            for task in tasks.iterdir():
                pids += map(int, (task / "children").read_text().split())
    return pids


def kill_tree(pid: int) -> None:
    for known in tree(pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(known, signal.SIGKILL)


class Gateway:
    def __init__(self, address: str, work: Path) -> None:
        flags = ["--cluster", address, "--state", str(work / "open")]
        flags += ["--models", str(work / "models"), "--record", str(work / "logs"), "--port", "0"]
        command = [sys.executable, "-m", "rendezview", "serve"]
        settings = {
            "RENDEZVIEW_SERVE_RECORD_MODEL": "false",
            "RENDEZVIEW_SERVE_SPARE_SEATS": "0",
            "RENDEZVIEW_SERVE_LOG_WAIT_S": "600",  # a busy machine's disk
        }
        self.process = subprocess.Popen(
            [*command, *flags], stderr=subprocess.PIPE, text=True, env=os.environ | settings
        )
        assert self.process.stderr is not None
        said = []
        with ends_in_time(self.process):
            for line in self.process.stderr:
                said.append(line)
                if "serves at" in line:
                    self.url = line.split("serves at")[1].strip()
                    break
            else:
                raise SystemExit("the gateway does not start: " + "".join(said))
        self._reader = threading.Thread(target=self._pass_on, daemon=True)
        self._reader.start()

    def _pass_on(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if "seat" in line and "audit" not in line:
                print(line, end="", file=sys.stderr, flush=True)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(MOST_S)
        self._reader.join(MOST_S)
        assert self.process.stderr is not None
        self.process.stderr.close()


def slots_of(gateway: Gateway) -> list[dict]:
    with Client(gateway.url) as client:
        return client.request("GET", "/readyz")["seats"]


def wait_for(gateway: Gateway, slots: int) -> None:
    """Until so many slots have a session, or are ready to continue one."""
    until_s = time.monotonic() + 900.0
    while time.monotonic() < until_s:
        with contextlib.suppress(RendezviewError):
            if sum(s["warm"] or bool(s["session"]) for s in slots_of(gateway)) >= slots:
                return
        time.sleep(0.2)
    raise SystemExit("the slots are not ready in time")
