"""Kill the recording service repeatedly, and count acknowledged poses that are lost."""

from __future__ import annotations

import contextlib
import itertools
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.frame import tests_module
from experiments.service.serving import Loop
from rendezview import Client, RendezviewError
from rendezview_service.logs.log_repair import mend
from rendezview_service.logs.replay import read_log


def send(url: str, scene: Path, name: str, acknowledged: dict[str, list[dict]]) -> None:
    """Frames as fast as they are answered, until the service is killed."""
    loop, states = Loop(scene), acknowledged.setdefault(name, [])
    with contextlib.suppress(RendezviewError, OSError), Client(url) as client:
        session = client.open(loop.camera, name=name)
        for k in itertools.count():
            time_s, image = loop(k)
            state = session.track(image, time_s)
            if state["recorded"]:
                states.append(state)


def campaign(serve: Callable[..., Any], scene: Path, kills: int, seed: int) -> bool:
    """Kill the recording service repeatedly; whether no acknowledged pose is lost.

    Each time a service starts with a log, two clients send frames as fast as they are answered,
    and after a random time the whole process group gets kill -9. The log is read as it was left,
    and again after mending, by the reader of the mcap package. Every answer with
    "recorded": true must be there, number for number. ``serve`` starts one with flags and settings.
    """
    rng = np.random.default_rng(seed)
    total = lost = unreadable = cut_bytes = 0
    for done in range(1, kills + 1):
        with tempfile.TemporaryDirectory() as work:
            folder = Path(work) / "logs"
            folder.mkdir()
            # Logs without the model: written each time it only takes time.
            flags = ("--workers", "1", "--record", str(folder), "--models", f"{work}/models")
            served = serve(*flags, record_model="false")
            acknowledged: dict[str, list[dict]] = {}
            threads = [
                threading.Thread(target=send, args=(served.url, scene, name, acknowledged))
                for name in ("one", "two")
            ]
            for thread in threads:
                thread.start()
            until = time.monotonic() + 20.0
            while not any(acknowledged.values()) and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(float(rng.uniform(0.0, 1.0)))
            served.kill()
            for thread in threads:
                thread.join()
            for name, states in acknowledged.items():
                total += len(states)
                path = next(folder.glob(f"{name}-*.mcap"), folder / f"{name}.mcap")
                try:
                    kept = [f.state for f in read_log(path).frames() if f.state is not None]
                    as_left = {state["frame"]: state for state in kept}
                    repaired = mend(path)
                    mended = tests_module("service.logged").states_of(path)
                except Exception as error:  # any error of a reader
                    print(f"{path}: {error!r}")
                    unreadable += path.exists()
                    lost += len(states)
                    continue
                cut_bytes += 0 if repaired is None else repaired.cut_bytes
                lost += sum(
                    as_left.get(s["frame"]) != s or mended.get(s["frame"]) != s for s in states
                )
        print(f"{done} of {kills}: {total} poses, {lost} lost", file=sys.stderr, flush=True)
    print(
        f"seed {seed}: {kills} kills, {total} acknowledged poses, {lost} lost, {unreadable} logs "
        f"unreadable; {cut_bytes} bytes of half frames cut"
    )
    return not (lost or unreadable)
