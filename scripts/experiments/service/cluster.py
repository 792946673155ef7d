"""The service on a Ray cluster of several nodes on this machine: kills, hops, nodes, a model."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
from rendezview.client import Client
from rendezview.client.messages import ServiceError
from rendezview.service.log_repair import mend

from experiments.service.kill import states_of
from experiments.service.serving import Loop
from rendezview.errors import RendezviewError

_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
    "RAY_timeout_ms_task_wait_for_death_info": "100",
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

    def kill_steward(self) -> None:
        """kill -9 of the steward; Ray starts it again."""
        raylet = self.cluster.head_node.all_processes["raylet"][0].process.pid
        for pid in tree(raylet):
            with contextlib.suppress(OSError):
                if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::Steward"):
                    os.kill(pid, signal.SIGKILL)
                    return
        raise SystemExit("no steward is found")

    def kill_head(self) -> None:
        """kill -9 of the head node: of Ray's directory and of the steward."""
        for kind in ("gcs_server", "raylet"):
            for started in self.cluster.head_node.all_processes[kind]:
                kill_tree(started.process.pid)

    def replace(self, place: int) -> None:
        """A new node takes the place of one that was killed."""
        node = self.nodes[place]
        with contextlib.suppress(Exception):
            self.cluster.remove_node(node, allow_graceful=False)
        self.nodes[place] = self.add()


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
        flags = ["--cluster", address, "--cluster-folder", str(work / "open")]
        flags += ["--models", str(work / "models"), "--record", str(work / "logs"), "--port", "0"]
        command = [sys.executable, "-c", "from rendezview.cli.main import main; main()", "serve"]
        settings = {"RENDEZVIEW_SERVE_RECORD_MODEL": "false", "RENDEZVIEW_SERVE_SPARE_SEATS": "0"}
        self.process = subprocess.Popen(
            [*command, *flags], stderr=subprocess.PIPE, text=True, env=os.environ | settings
        )
        assert self.process.stderr is not None
        said = []
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
        self.process.wait()
        self._reader.join()
        assert self.process.stderr is not None
        self.process.stderr.close()


class Sender:
    """Sends frames as fast as they are answered, to another gateway if one is gone."""

    def __init__(self, gateways: list[Gateway], name: str, loop: Loop) -> None:
        self.gateways, self.name, self.loop = gateways, name, loop
        self.states: list[dict] = []
        self.at_s: list[float] = []
        self.errors: list[str] = []
        self.stop = False
        with Client(gateways[0].url) as client:
            client.open(loop.camera, name=name, prior=loop.prior, model="client", idle_s=600.0)
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        k = turn = 0
        while not self.stop:
            with Client(
                self.gateways[turn % len(self.gateways)].url, reconnect_s=0.0, sender="one"
            ) as client:
                session = client.session(self.name)
                try:
                    while not self.stop:
                        self.send(session, k)
                        k += 1
                except ServiceError as error:
                    self.errors.append(str(error))
                    time.sleep(0.05)
                    # Tracked by the gateway that ended before it answered: go on.
                    k += "not later" in str(error)
                    turn += error.status == 409
                except (RendezviewError, OSError):
                    turn += 1
                    time.sleep(0.01)

    def send(self, session, k: int) -> None:
        time_s, image = self.loop(k)
        state = session.track(image, time_s)
        self.at_s.append(time.monotonic())
        if state["recorded"]:
            self.states.append(state)

    def gap_s(self, since_s: float) -> float:
        """Longest time between two answers since then."""
        times = [since_s, *(t for t in self.at_s if t > since_s), time.monotonic()]
        return float(np.diff(times).max())

    def floor_s(self, until_s: float) -> float:
        """The same in the second before."""
        start_s = until_s - 1.0
        times = [start_s, *(t for t in self.at_s if start_s < t < until_s), until_s]
        return float(np.diff(times).max())

    def lost(self, folder: Path) -> int:
        """Acknowledged states that are not in the session's logs, number for number."""
        found: dict[int, list[dict]] = {}
        for path in folder.glob(f"{self.name}-*.mcap"):
            mend(path)
            for frame, state in states_of(path).items():
                found.setdefault(frame, []).append(state)
        return sum(state not in found.get(state["frame"], []) for state in self.states)


def seats_of(gateway: Gateway) -> list[dict]:
    with Client(gateway.url) as client:
        return client.request("GET", "/readyz")["seats"]


def wait_for(gateway: Gateway, seats: int) -> None:
    """Until so many seats have a session, or are ready to continue one."""
    until_s = time.monotonic() + 900.0
    while time.monotonic() < until_s:
        with contextlib.suppress(RendezviewError):
            if sum(s["warm"] or bool(s["session"]) for s in seats_of(gateway)) >= seats:
                return
        time.sleep(0.2)
    raise SystemExit("the seats are not ready in time")


def without_head(ray_nodes: Nodes, gateways: list[Gateway], sender: Sender) -> str:
    """What becomes of the session when the head node is killed."""
    since_s = time.monotonic()
    ray_nodes.kill_head()
    told = ""
    while any(gateway.process.poll() is None for gateway in gateways):
        if time.monotonic() - since_s > 150.0:
            break
        time.sleep(1.0)
        with (
            contextlib.suppress(OSError),
            urllib.request.urlopen(f"{gateways[0].url}healthz", timeout=10.0) as answer,
        ):
            told = json.loads(answer.read())["reasons"][0]
    answered_s = [at_s - since_s for at_s in sender.at_s if at_s > since_s]
    codes = [gateway.process.poll() for gateway in gateways]
    return (f"head: {len(answered_s)} answers after its end, the last after "
            f"{max(answered_s, default=0.0):.0f} s; gateways said {told!r} and ended with codes "
            f"{codes} after {time.monotonic() - since_s:.0f} s")  # fmt: skip


def renewed(ray_nodes: Nodes, gateways: list[Gateway], count: int, work: Path):
    """A new cluster, as an operator starts it after the head node is lost."""
    for gateway in gateways:
        gateway.kill()
    ray_nodes.cluster.shutdown()
    ray_nodes = Nodes(count)
    gateways = [Gateway(ray_nodes.cluster.address, work) for _ in gateways]
    wait_for(gateways[0], count)
    return ray_nodes, gateways


def run(
    model: Path, scene: Path, *, nodes: int = 3, kills: int = 50, seed: int = 0,
    minutes: float = 1000.0,
) -> None:  # fmt: skip
    """Kill nodes, gateways and the steward while one session tracks; at last the head node.

    Nodes are processes on this machine, one core each, all of them killed with kill -9 together
    with their children. One client sends frames over two gateways. Every answer with
    "recorded": true must be in the logs; a gap is the longest time between two answers around a
    kill, and each tenth kill is the steward's. After --minutes no further one is begun. When the
    head node is killed, frames are sent for as long as they are answered; then a new cluster on
    the same folders must continue the session.
    """
    rng = np.random.default_rng(seed)
    end_s = time.monotonic() + 60.0 * minutes
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in ("open", "models", "logs"):
            (work / name).mkdir()
        shutil.copy(model, work / "models" / "client.rvm")
        ray_nodes = Nodes(nodes)
        address = ray_nodes.cluster.address
        gateways = [Gateway(address, work) for _ in range(2)]
        try:
            wait_for(gateways[0], nodes)
            sender = Sender(gateways, "run", Loop(scene))
            wait_for(gateways[0], nodes)
            gaps: dict[str, list[float]] = {"node": [], "gateway": [], "steward": []}
            floors: list[float] = []
            for number in range(kills):
                if time.monotonic() > end_s:
                    break
                time.sleep(float(rng.uniform(0.5, 1.5)))
                kind = "gateway" if number % 2 else "node"
                kind = "steward" if number % 10 == 9 else kind
                since_s = time.monotonic()
                if kind == "gateway":
                    place = int(rng.integers(2))
                    gateways[place].kill()
                elif kind == "steward":
                    ray_nodes.kill_steward()
                else:
                    node = next(s["node"] for s in seats_of(gateways[0]) if s["session"])
                    place = [n.node_id for n in ray_nodes.nodes].index(node)
                    since_s = time.monotonic()
                    ray_nodes.kill_only(place)
                while sender.at_s[-1] < since_s + 0.05 and time.monotonic() < since_s + 20.0:
                    time.sleep(0.02)
                time.sleep(10.0 if kind == "steward" else 1.0)  # while it starts again
                gaps[kind].append(sender.gap_s(since_s))
                floors.append(sender.floor_s(since_s))
                if kind == "gateway":
                    gateways[place] = Gateway(address, work)
                elif kind == "node":
                    ray_nodes.replace(place)
                wait_for(gateways[0], nodes)
                print(f"{number + 1} {kind}: gap {gaps[kind][-1]:.2f} s, "
                      f"before {floors[-1]:.2f} s", flush=True)  # fmt: skip
            print(without_head(ray_nodes, gateways, sender), flush=True)
            sender.stop = True
            sender.thread.join()
            ray_nodes, gateways = renewed(ray_nodes, gateways, nodes, work)
            last = sender.states[-1]["frame"]
            with Client(gateways[0].url, sender="one") as client:
                session = client.session("run")
                again = session.track(sender.loop.images[0], 1e6)
                print(f"a new cluster continues with frame {again['frame']} after {last}")
                session.close()
            lost = sender.lost(work / "logs")
            for kind, all_s in gaps.items():
                if all_s:
                    late = sum(gap_s > 2.0 for gap_s in all_s)
                    print(f"{kind}: {len(all_s)} kills, gap median {np.median(all_s):.2f} s, "
                          f"longest {max(all_s):.2f} s; {late} over 2 s")  # fmt: skip
            print(f"longest time between two answers in the second before each kill: median "
                  f"{np.median(floors):.2f} s, most {max(floors):.2f} s")  # fmt: skip
            print(f"seed {seed}: {len(sender.states)} acknowledged poses, {lost} lost, "
                  f"{len(sender.errors)} frames refused")  # fmt: skip
        finally:
            for gateway in gateways:
                gateway.kill()
            ray_nodes.cluster.shutdown()
    sys.exit(bool(lost))
