"""The service as a process, and frames for it."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from rendezview import Client, RendezviewError, open_sequence


class Loop:
    """Frames of a scene to and fro, with times that rise."""

    def __init__(self, scene: Path) -> None:
        sequence = open_sequence(scene)
        self.camera = sequence.frames[0].camera
        self.prior = sequence.frames[0].camera_from_target
        images = [frame.read() for frame in sequence]
        self.images = images + images[-2:0:-1]

    def __call__(self, k: int) -> tuple[float, np.ndarray]:
        return k / 30.0, self.images[k % len(self.images)]


class Processes:
    """A service's processes: what they cost."""

    def __init__(self, url: str, pid: int) -> None:
        self.url, self.pid = url, pid

    def pids(self) -> list[int]:
        """Of the service and its workers."""
        children = Path(f"/proc/{self.pid}/task/{self.pid}/children")
        return [self.pid, *map(int, children.read_text().split())]

    def processor_s(self) -> float:
        """Processor time of the service and its workers."""
        ticks = 0
        for pid in self.pids():
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
        return ticks / os.sysconf("SC_CLK_TCK")

    def resident_mb(self, *pids: int) -> float:
        """Memory of the service and its workers, or of some of them."""
        found = [Path(f"/proc/{p}/statm").read_text().split() for p in pids or self.pids()]
        pages = [int(fields[1]) for fields in found]
        return sum(pages) * resource.getpagesize() / 1e6


class Served(Processes):
    """`rendezview serve` as a process, or as a process group; ``settings``: RENDEZVIEW_SERVE_…"""

    def __init__(self, model: Path, *flags: str, group: bool = False, **settings: object) -> None:
        command = [sys.executable, "-m", "rendezview"]
        names = {f"RENDEZVIEW_SERVE_{n.upper()}": str(value) for n, value in settings.items()}
        self.process = subprocess.Popen(
            [*command, "serve", str(model), "--port", "0", *flags], stderr=subprocess.PIPE,
            text=True, start_new_session=group, env=os.environ | names,
        )  # fmt: skip
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if "serves at" in line:
                super().__init__(line.split("serves at")[1].strip(), self.process.pid)
                break
        else:
            raise SystemExit("the service does not start")
        self.log: list[str] = []  # its last lines
        threading.Thread(target=self._drain, daemon=True).start()

    def _drain(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if '"audit"' not in line:
                self.log = [*self.log[-199:], line.rstrip()]

    def await_ready(self, within_s: float = 600.0) -> None:
        """Wait until it can track; a first start on a machine compiles for minutes."""
        until_s = time.monotonic() + within_s
        while True:
            try:
                with Client(self.url) as client:
                    client.request("GET", "/readyz")
                return
            except RendezviewError as error:
                if time.monotonic() > until_s or self.process.poll() is not None:
                    raise SystemExit(f"the service is not ready: {error}") from None
            time.sleep(0.2)

    def kill(self) -> None:
        """`kill -9` of the whole group at once."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """As an operator ends it."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60)
