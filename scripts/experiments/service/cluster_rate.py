"""What the service on a Ray cluster costs: processor time a frame of each process on its way."""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from rendezview.client import Client

from experiments.service.cluster import Gateway, Nodes, seats_of, wait_for
from experiments.service.serving import Loop, Served


def spent_s() -> dict[str, float]:
    """Processor time of the processes on a frame's way, by kind."""
    found: dict[str, float] = defaultdict(float)
    for place in Path("/proc").iterdir():
        if not place.name.isdigit():
            continue
        try:
            line = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            fields = (place / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        kinds = {
            "gateway": "--cluster-folder" in line,
            "seat": "ray::Seat" in line,
            "worker": "rendezview.service.worker" in line and belongs(place.name),
            "raylets": "raylet/raylet" in line,
        }
        for kind, is_it in kinds.items():
            if is_it:
                found[kind] += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


def belongs(pid: str) -> bool:
    """Whether a worker is a seat's."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return b"ray::Seat" in Path(f"/proc/{fields[1]}/cmdline").read_bytes()
    except OSError:
        return False


def send(url: str, loop: Loop, name: str, frames: int, latencies: list[float]) -> None:
    with (
        Client(url) as client,
        client.open(
            loop.camera, name=name, prior=loop.prior, model="client", idle_s=600.0
        ) as session,
    ):
        for k in range(frames + 20):
            time_s, image = loop(k)
            start_s = time.monotonic()
            state = session.track(image, time_s)
            if k >= 20:
                latencies.append(1e3 * (time.monotonic() - start_s) - state["track_ms"])


def rate(url: str, loop: Loop, sessions: int, frames: int) -> tuple[float, list[float]]:
    """Frames a second of all sessions, and what each frame took beside its tracker, ms."""
    latencies: list[float] = []
    threads = [
        threading.Thread(target=send, args=(url, loop, f"s{k}", frames, latencies))
        for k in range(sessions)
    ]
    start_s = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sessions * (frames + 20) / (time.monotonic() - start_s), latencies


def beside(latencies: list[float]) -> str:
    median, best = np.median(latencies), np.quantile(latencies, 0.1)
    return f"{median:.1f} ms beside the tracker (best tenth {best:.1f})"


def run(model: Path, scene: Path, *, nodes: int = 3, frames: int = 300) -> None:
    """Processor time a frame of gateway, seat, worker and Ray, with 1 … nodes sessions.

    Sessions are on nodes of their own, all behind one gateway; frames are raw and recorded. The
    rate that a cluster of machines of their own would have follows from the processor times: each
    session needs a core for seat, worker and Ray, all sessions together the gateway's. The plain
    service on this machine, with the same frames, is the comparison.
    """
    loop = Loop(scene)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in ("open", "models", "logs"):
            (work / name).mkdir()
        shutil.copy(model, work / "models" / "client.rvm")
        flags = ("--workers", "1", "--record", str(work / "logs"))
        served = Served(work / "models" / "client.rvm", *flags, record_model="false")
        served.await_ready()
        before_s = served.processor_s()
        per_s, latencies = rate(served.url, loop, 1, frames)
        spent = 1e3 * (served.processor_s() - before_s) / (frames + 20)
        told = f"{spent:.1f} ms of processor time a frame; {beside(latencies)}"
        print(f"plain service: {told}; {per_s:.0f} frames a second here", flush=True)
        served.stop()
        ray_nodes = Nodes(nodes)
        gateway = Gateway(ray_nodes.cluster.address, work)
        try:
            wait_for(gateway, nodes)
            for sessions in range(1, nodes + 1):
                while len([s for s in seats_of(gateway) if s["session"] is None]) < nodes:
                    time.sleep(0.2)  # of the last turn
                before = spent_s()
                per_s, latencies = rate(gateway.url, loop, sessions, frames)
                count, after = sessions * (frames + 20), spent_s()
                each = {kind: 1e3 * (after[kind] - before[kind]) / count for kind in after}
                own = sum(each.values()) - each["gateway"]
                told = ", ".join(f"{kind} {value:.1f}" for kind, value in sorted(each.items()))
                own_per_s = sessions * min(1e3 / own, 1e3 / each["gateway"] / sessions)
                print(f"{sessions} sessions: {told} ms of processor time a frame")
                print(f"  {beside(latencies)}; {per_s:.0f} frames a second here, with cores "
                      f"of their own {own_per_s:.0f}", flush=True)  # fmt: skip
        finally:
            gateway.kill()
            ray_nodes.cluster.shutdown()
