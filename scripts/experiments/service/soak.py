"""An hour of steady use: the memory of the service and its workers, minute by minute."""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from experiments.service.serving import Loop, serve
from rendezview import Client

_WARM_MIN = 30  # history, caches and allocators fill; a log's part lasts ten minutes here
_ENOUGH_MB = 2.0  # that memory may change by after that


def watch(url: str) -> None:
    """A page that is open all the time."""
    try:
        with connect(url, compression=None, max_size=None) as socket:
            for _ in socket:
                pass
    except ConnectionClosed:
        pass


def soak(model: Path, scene: Path, minutes: int, rate_hz: float) -> bool:
    """Whether memory stays level with one session by requests, recorded, watched and checkpointed,
    and with a second one that opens each minute, tracks three frames by a stream, and closes."""
    loop, served_mb = Loop(scene), []
    with tempfile.TemporaryDirectory() as work:
        kept = ("--record", f"{work}/logs", "--state", f"{work}/state")
        Path(work, "logs").mkdir()
        served = serve(model, "--workers", "1", *kept, log_part_s=600.0)
        watched = f"{served.url.replace('http', 'ws')}v1/sessions/steady/watch"
        with Client(served.url) as client:
            session = client.open(loop.camera, prior=loop.prior, name="steady")
            threading.Thread(target=watch, args=(watched,), daemon=True).start()
            start_s, k = time.monotonic(), 0
            for minute in range(1, minutes + 1):
                with client.open(loop.camera, prior=loop.prior) as other, other.stream() as stream:
                    for j in range(3):
                        time_s, image = loop(j)
                        stream.send(image, time_s)
                        stream.receive(30.0)
                while time.monotonic() < start_s + 60.0 * minute:
                    time_s, image = loop(k)
                    session.track(image, time_s)
                    k += 1
                    time.sleep(max(0.0, start_s + k / rate_hz - time.monotonic()))
                served_mb.append((served.resident_mb(served.process.pid), served.resident_mb()))
                told = "service {:.1f} MB, all {:.1f} MB".format(*served_mb[-1])
                print(f"{minute} min, {k} frames: {told}", file=sys.stderr, flush=True)
        served.stop()
    after = np.array(served_mb[_WARM_MIN:])
    if not len(after):
        return True
    lowest, highest = after.min(axis=0), after.max(axis=0)
    slope = np.polyfit(np.arange(len(after)) / 60.0, after, 1)[0] if len(after) > 1 else [0.0, 0.0]
    for what, low, high, grows in zip(("service", "all"), lowest, highest, slope, strict=True):
        print(f"{what}: {low:.1f} to {high:.1f} MB after {_WARM_MIN} min, {grows:+.1f} MB an hour")
    return bool((highest - lowest <= 2 * _ENOUGH_MB).all())
