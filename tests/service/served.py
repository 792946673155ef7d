"""The service as a process: what it says and costs; for tests and experiments."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
from tests.waiting import MOST_S, ends_in_time, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.client import Client


@dataclass
class Served:
    """`rendezview serve` as a process of its own; its group is killed with it."""

    process: subprocess.Popen[str]
    url: str
    folder: Path
    written: deque[str]  # lines of its log; a thread adds to them

    @classmethod
    def start(
        cls,
        *arguments: str,
        folder: Path,
        environment: dict[str, str],
        most_lines: int | None = None,
    ) -> Served:
        """On a free port; ``most_lines`` of its log are kept."""
        process = subprocess.Popen(
            [sys.executable, "-m", "rendezview", "serve", "--port", "0", *arguments],
            stderr=subprocess.PIPE, text=True, cwd=folder, env=os.environ | environment,
            start_new_session=True,
        )  # fmt: skip
        served = cls(process, "", folder, deque(maxlen=most_lines))
        assert process.stderr is not None
        with ends_in_time(process):
            for line in process.stderr:
                served.written.append(line)
                if "serves at" in line:
                    served.url = line.split("serves at ")[1].strip()
                    break
            else:
                raise RuntimeError(f"the service does not start: {''.join(served.lines)}")
        threading.Thread(target=served.written.extend, args=(process.stderr,), daemon=True).start()
        return served

    @property
    def lines(self) -> list[str]:
        """Of its log, so far."""
        return list(self.written)

    def client(self, token: str | None = None) -> Client:
        return Client(self.url, token, timeout_s=MOST_S)

    def states_reported(self, session: str, last: str, message: str | None = None) -> list[str]:
        """States in the log's lines on a session, once ``last`` is: lines come in behind."""

        def states() -> list[str]:
            said = [json.loads(line) for line in self.lines if line.startswith("{")]
            told = [line for line in said if message is None or line["message"] == message]
            own = [line for line in told if line.get("session") == session]
            return [line["state"] for line in own if "state" in line]

        wait_until(lambda: last in states(), states)
        return states()

    def await_line(self, part: str) -> None:
        """Wait for a line of its log that has these words."""
        wait_until(lambda: any(part in line for line in self.lines), lambda: self.lines)

    def await_ready(self) -> None:
        """Wait until it can track; a first start on a machine compiles for minutes."""

        def ready() -> bool:
            assert self.process.poll() is None, self.lines
            with contextlib.suppress(RendezviewError), self.client() as client:
                client.request("GET", "/readyz")
                return True
            return False

        wait_until(ready)

    @property
    def workers(self) -> list[int]:
        """Numbers of its worker processes, known by what they run."""
        children = psutil.Process(self.process.pid).children()
        return [child.pid for child in children if _is_worker(child)]

    def pids(self) -> list[int]:
        """Of the service and its workers; what compiles loops beside them ends by itself."""
        return [self.process.pid, *self.workers]

    def processor_s(self) -> float:
        """Processor time of the service and its workers."""
        return sum(sum(psutil.Process(pid).cpu_times()[:2]) for pid in self.pids())

    def resident_mb(self, *pids: int) -> float:
        """Memory of the service and its workers, or of some of them."""
        return sum(psutil.Process(pid).memory_info().rss for pid in pids or self.pids()) / 1e6

    @contextlib.contextmanager
    def full_disk(self) -> Iterator[None]:
        """No file of its workers may grow, which fails as a full disk does."""
        for pid in self.workers:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        yield
        for pid in self.workers:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)

    def kill(self) -> None:
        """-9, workers included: as when the power of a process is gone."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(MOST_S)

    def stop(self) -> None:
        """As an operator ends it."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(MOST_S)


def _is_worker(process: psutil.Process) -> bool:
    """A new child of the service looks like the service itself until it runs its program."""
    try:
        return "rendezview_service.worker.worker" in process.cmdline()
    except psutil.NoSuchProcess:
        return False
