"""How long a session has no poses when its worker ends and the spare one continues."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from rendezview.client import Client
from rendezview.client.messages import ServiceError

from experiments.service.serving import Loop, Served


def processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def busiest(served: Served, for_s: float) -> int:
    """The worker that tracks."""
    workers = served.pids()[1:]
    before = {pid: processor_s(pid) for pid in workers}
    time.sleep(for_s)
    return max(workers, key=lambda pid: processor_s(pid) - before[pid])


class Sender:
    """A session of its own: one whose frames end three processes is closed."""

    def __init__(self, url: str, loop: Loop, name: str) -> None:
        self.url, self.loop, self.name = url, loop, name
        self.poses_s = [time.monotonic()]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self) -> None:
        with Client(self.url) as client:
            session = client.open(self.loop.camera, prior=self.loop.prior, name=self.name)
            k = 0
            while not self._stop.is_set():
                k += 1
                try:
                    if session.track(self.loop(k)[1], k / 30.0)["pose"] is not None:
                        self.poses_s.append(time.monotonic())
                except ServiceError:
                    time.sleep(0.005)
            session.close()

    def longest_s(self, start_s: float, end_s: float) -> float:
        inside = [at_s for at_s in self.poses_s if start_s < at_s < end_s]
        return float(np.diff([start_s, *inside, end_s]).max())

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def run(model: Path, scene: Path, *, kills: int = 20, seed: int = 0, record: bool = False) -> None:
    """Kill the worker of a session; the longest time between two poses around each kill.

    One worker and a spare one that is ready. Frames go as fast as they are answered. The gap is
    set against the floor of the same run: the longest time between two poses in the same time
    before the kill. With --record the session has a log, with the model in each of its parts.
    """
    rng = np.random.default_rng(seed)
    loop = Loop(scene)
    folder = tempfile.TemporaryDirectory()
    served = Served(model, "--workers", "1", *(["--record", folder.name] if record else []))
    served.await_ready()
    gaps, floors = [], []
    for number in range(kills):
        while sum("a spare worker is ready" in line for line in served.log) <= number:
            time.sleep(0.1)
        sender = Sender(served.url, loop, f"moved-{number}")
        time.sleep(float(rng.uniform(2.5, 3.5)))
        victim = busiest(served, 0.5)
        at_s = time.monotonic()
        os.kill(victim, signal.SIGKILL)
        while sender.poses_s[-1] < at_s + 0.01:
            time.sleep(0.01)
        time.sleep(1.0)
        gaps.append(sender.longest_s(at_s, time.monotonic()))
        floors.append(sender.longest_s(at_s - 2.0, at_s))
        sender.end()
        print(f"{number + 1}: {gaps[-1]:.2f} s, before {floors[-1]:.2f} s", flush=True)
    served.stop()
    folder.cleanup()
    print(f"seed {seed}: {kills} kills, gap median {np.median(gaps):.2f} s, longest "
          f"{max(gaps):.2f} s; before the kills median {np.median(floors):.2f} s, longest "
          f"{max(floors):.2f} s")  # fmt: skip
