"""Whether the service's memory stays level while it tracks, records and is watched for hours."""

from __future__ import annotations

import csv
import sys
import tempfile
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from experiments.service.serving import Loop, serve
from rendezview import Client

SAMPLED_S = 30.0
OPENED_S = 60.0  # a short session, every so many seconds
ENOUGH_MB = 2.0  # that a median may change by
# Memory of the service, and of it and its workers: RSS counts what they share, USS does not.
COLUMNS = ("minute", "frames", "service RSS", "service USS", "all RSS", "all USS")


def watch(url: str) -> None:
    """A page that is open all the time."""
    with suppress(ConnectionClosed), connect(url, compression=None, max_size=None) as socket:
        deque(socket, maxlen=0)


def memory_mb(pids: list[int]) -> list[float]:
    """RSS and USS of the first process, then of all."""
    used = [psutil.Process(pid).memory_full_info() for pid in pids]
    each = np.array([[one.rss, one.uss] for one in used]) / 1e6
    return [*each[0], *each.sum(axis=0)]


def soak(model: Path, scene: Path, minutes: int, rate_hz: float, log: Path) -> None:
    """One session by requests, recorded, watched and checkpointed, and each minute a second one
    that opens, tracks three frames by a stream, and closes. Samples of memory go to ``log``."""
    loop, k = Loop(scene), 0
    with tempfile.TemporaryDirectory() as work, log.open("w", buffering=1) as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS)
        kept = ("--record", f"{work}/logs", "--state", f"{work}/state")
        Path(work, "logs").mkdir()
        served = serve(model, "--workers", "1", *kept, log_part_s=600.0, logs_bytes=2_000_000_000)
        watched = f"{served.url.replace('http', 'ws')}v1/sessions/steady/watch"
        with Client(served.url) as client:
            session = client.open(loop.camera, prior=loop.prior, name="steady")
            threading.Thread(target=watch, args=(watched,), daemon=True).start()
            start_s = time.monotonic()
            sampled_s = opened_s = start_s
            while (now_s := time.monotonic()) < start_s + 60.0 * minutes:
                if now_s >= opened_s:
                    opened_s += OPENED_S
                    open_another(client, loop)
                if now_s >= sampled_s:
                    sampled_s += SAMPLED_S
                    memory = (f"{used:.2f}" for used in memory_mb(served.pids()))
                    rows.writerow([f"{(now_s - start_s) / 60.0:.1f}", k, *memory])
                time_s, image = loop(k)
                session.track(image, time_s)
                k += 1
                time.sleep(max(0.0, start_s + k / rate_hz - time.monotonic()))
        served.stop()


def open_another(client: Client, loop: Loop) -> None:
    """A short session: three frames by a stream."""
    with client.open(loop.camera, prior=loop.prior) as other, other.stream() as stream:
        for k in range(3):
            time_s, image = loop(k)
            stream.send(image, time_s)
            stream.receive(30.0)


def is_level(log: Path) -> bool:
    """Print the medians of a soak's quarters; whether memory does not drift.

    That is: the halves of the service's own differ little, and so do the last two quarters of the
    workers', whose buffers take half an hour to reach their sizes.
    """
    rows = np.loadtxt(log, delimiter=",", skiprows=1, ndmin=2)
    minutes, level = rows[:, 0], True
    quarter = np.minimum(4.0 * minutes / minutes[-1], 3.0).astype(int)
    print(f"{minutes[-1]:.0f} minutes, {rows[-1, 1]:.0f} frames, {len(rows)} samples; medians")
    for what, used in zip(COLUMNS[2:], rows[:, 2:].T, strict=True):
        medians = [np.median(used[quarter == k]) for k in range(4)]
        halves = np.median(used[quarter > 1]) - np.median(used[quarter < 2])
        late, told = medians[3] - medians[2], ", ".join(f"{one:.1f}" for one in medians)
        print(f"{what}: quarters {told} MB; {halves:+.1f} between halves, {late:+.1f} at the end")
        drifts = abs(late) > ENOUGH_MB or ("all" not in what and abs(halves) > ENOUGH_MB)
        level &= not drifts
    return level


def command(model: Path, scene: Path, minutes: int, rate_hz: float, log: Path) -> None:
    """Soak, unless ``log`` is there already; the exit status is 1 where memory is not level."""
    if not log.exists():
        soak(model, scene, minutes, rate_hz, log)
    sys.exit(not is_level(log))
