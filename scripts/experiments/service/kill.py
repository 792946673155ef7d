"""Kill the recording service repeatedly, and count acknowledged poses that are lost."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from experiments.service.serving import Served
from rendezview.errors import RendezviewError
from rendezview.io.sequences import open_sequence
from rendezview_service.client import Client
from rendezview_service.logs.log_repair import mend
from rendezview_service.logs.replay import read_log


def serve(model: Path, folder: Path, models: Path) -> Served:
    """A recording service. Its logs are without the model: written 200 times it only takes time."""
    flags = ("--workers", "1", "--record", str(folder), "--models", str(models))
    return Served(model, *flags, group=True, record_model="false")


def send(url: str, scene: Path, name: str, acknowledged: dict[str, list[dict]]) -> None:
    sequence = open_sequence(scene)
    images = [frame.read() for frame in sequence]
    images += images[-2:0:-1]
    states = acknowledged.setdefault(name, [])
    try:
        with Client(url) as client:
            session = client.open(sequence.frames[0].camera, name=name)
            k = 0
            while True:
                state = session.track(images[k % len(images)], k / 30.0)
                if state["recorded"]:
                    states.append(state)
                k += 1
    except (RendezviewError, OSError):
        pass  # killed


def states_of(path: Path) -> dict[int, dict]:
    with open(path, "rb") as file:
        found = {}
        messages = make_reader(file).iter_messages(topics=["/rendezview/state"])
        for _, _, message in messages:
            state = json.loads(message.data)
            found[state["frame"]] = state
    return found


def run(model: Path, scene: Path, *, kills: int = 100, seed: int = 0) -> None:
    """Kill the recording service repeatedly, and count acknowledged poses that are lost.

    Each time a service starts with a log, two clients send frames as fast as they are answered,
    and after a random time the whole process group gets kill -9. The log is read as it was left,
    and again after mending, by the reader of the mcap package. Every answer with
    "recorded": true must be there, number for number.
    """
    rng = np.random.default_rng(seed)
    acknowledged_in_all = lost = unreadable = cut_files = cut_bytes = 0
    with tempfile.TemporaryDirectory() as work, ThreadPoolExecutor(1) as starter:

        def start(number: int) -> Future[Served]:
            folder = Path(work) / f"logs-{number}"
            folder.mkdir()
            return starter.submit(serve, model, folder, Path(work) / f"models-{number}")

        upcoming = start(1)
        for done in range(1, kills + 1):
            folder = Path(work) / f"logs-{done}"
            served = upcoming.result()
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
            if done < kills:
                upcoming = start(done + 1)  # while the logs of this one are read
            for thread in threads:
                thread.join()
            for name, states in acknowledged.items():
                acknowledged_in_all += len(states)
                paths = list(folder.glob(f"{name}-*.mcap"))
                if not paths:
                    lost += len(states)
                    continue
                try:
                    as_left = {
                        f.state["frame"]: f.state
                        for f in read_log(paths[0]).frames()
                        if f.state is not None
                    }
                    mended_log = mend(paths[0])
                    mended = states_of(paths[0])
                except Exception as error:  # any error of a reader
                    print(f"{paths[0]}: {error}")
                    unreadable += 1
                    lost += len(states)
                    continue
                if mended_log is not None:
                    cut_files += mended_log.cut_bytes > 0
                    cut_bytes += mended_log.cut_bytes
                lost += sum(
                    as_left.get(s["frame"]) != s or mended.get(s["frame"]) != s for s in states
                )
            shutil.rmtree(folder)
            shutil.rmtree(Path(work) / f"models-{done}", ignore_errors=True)
            progress = f"{done} of {kills}: {acknowledged_in_all} poses, {lost} lost"
            print(f"\r{progress}", end="", file=sys.stderr, flush=True)
    print(
        f"seed {seed}: {kills} kills, {acknowledged_in_all} acknowledged "
        f"poses, {lost} lost, {unreadable} logs unreadable; {cut_files} logs ended in half a "
        f"frame ({cut_bytes} bytes cut)"
    )
    sys.exit(bool(lost or unreadable))
