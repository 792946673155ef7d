"""Cost of the service over the bare tracker call, and throughput with several clients."""

from __future__ import annotations

import time
from collections.abc import Callable
from multiprocessing import Queue, get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np

from experiments.service import soak
from experiments.service.serving import Loop, serve
from rendezview import Client, Recognizer, Tracker, ViewModel
from rendezview_service.client import ServiceError

ROUNDS, BLOCK = 20, 50  # blocks of frames in turns; the first warms up
CLIENTS, SECONDS = 8, 15.0  # of the throughput
ALONE_S = 8.0  # of the bare tracker


def overhead(loop: Loop, model: Path) -> None:
    """Blocks of frames in turns: bare, by requests, by a stream."""
    served = serve(model, "--workers", "1")
    client = Client(served.url)
    by_request = client.open(loop.camera, prior=loop.prior)
    stream = client.open(loop.camera, prior=loop.prior).stream()
    bare = Tracker(Recognizer(ViewModel.load(model), loop.camera), loop.prior)

    def streamed(image: np.ndarray, time_s: float) -> object:
        stream.send(image, time_s)
        return stream.receive(10.0)

    ways: dict[str, Callable[[np.ndarray, float], object]] = {
        "bare tracker call": lambda image, time_s: bare.update(time_s, image),
        "request (HTTP)": lambda image, time_s: by_request.track(image, time_s),
        "stream (WebSocket)": streamed,
    }
    spent_ms: dict[str, list[float]] = {name: [] for name in ways}
    for block in range(ROUNDS):
        for name, look in ways.items():
            for k in range(block * BLOCK, (block + 1) * BLOCK):
                time_s, image = loop(k)
                start = time.perf_counter()
                look(image, time_s)
                if block:
                    spent_ms[name].append(1e3 * (time.perf_counter() - start))
    stream.close()
    served.stop()
    floor = np.percentile(spent_ms["bare tracker call"], [10, 50])
    print(f"{BLOCK * (ROUNDS - 1)} frames each, 640 × 480 raw, one client:")
    for name, spent in spent_ms.items():
        (low, middle), (less, least) = (now := np.percentile(spent, [10, 50])), now - floor
        print(f"{name:22} median {middle:6.2f} ms, best tenth {low:6.2f} ms; over the bare call "
              f"{least:5.2f} and {less:5.2f} ms")  # fmt: skip


def run_client(url: str, scene: Path, ready: Barrier, results: Queue) -> None:
    """One client of many, in a process of its own: frames for some seconds."""
    loop = Loop(scene)
    with Client(url) as client:
        session = client.open(loop.camera, prior=loop.prior)
        ready.wait()
        start, done, k = time.perf_counter(), 0, 0
        while time.perf_counter() < start + SECONDS:
            time_s, image = loop(k)
            k += 1
            try:
                session.track(image, time_s)
                done += 1
            except ServiceError as error:
                if error.status != 429:
                    raise
        seconds = time.perf_counter() - start
        session.close()
    results.put((done, seconds))


def alone_ms(model: ViewModel, loop: Loop, seconds: float) -> float:
    """Processor time of a frame of the bare tracker."""
    tracker = Tracker(Recognizer(model, loop.camera), loop.prior)
    start, used, k = time.perf_counter(), time.thread_time(), 0
    while time.perf_counter() - start < seconds:
        time_s, image = loop(k)
        tracker.update(time_s, image)
        k += 1
    return 1e3 * (time.thread_time() - used) / k


def many(loop: Loop, model: Path, scene: Path) -> None:
    """Throughput, fairness and cost with several clients at once."""
    loaded = ViewModel.load(model)
    alone_ms(loaded, loop, 2.0)  # compiles
    served, bare_ms = serve(model), alone_ms(loaded, loop, ALONE_S)
    apart = get_context("spawn")
    ready, results = apart.Barrier(CLIENTS + 1), apart.Queue()
    task = (served.url, scene, ready, results)
    processes = [apart.Process(target=run_client, args=task) for _ in range(CLIENTS)]
    for process in processes:
        process.start()
    ready.wait()
    used_s = served.processor_s()
    frames, seconds = np.transpose([results.get() for _ in processes])
    service_s = served.processor_s() - used_s
    for process in processes:
        process.join()
    served.stop()
    total, rates = int(frames.sum()), frames / seconds
    uneven = 100 * (rates.max() - rates.min()) / rates.mean()
    print(
        f"{CLIENTS} clients, {total} frames: {rates.sum():.0f} frames/s; each {rates.min():.0f} to "
        f"{rates.max():.0f}, {uneven:.0f} % apart\nprocessor time a frame: bare tracker "
        f"{bare_ms:.2f} ms, service and workers {1e3 * service_s / total:.2f} ms"
    )


def run(
    model: Path, scene: Path, *, soak_min: int = 0, rate_hz: float = 5.0,
    soak_log: Annotated[Path, "of a soak; one that is there is only summed up"] = Path("soak.csv"),
) -> None:  # fmt: skip
    """Cost of the service over the bare tracker call, and throughput with eight clients.

    SCENE is a folder that rendezview simulate wrote, 640 × 480, of the model's target, moving
    little from frame to frame (--dt 0.0333 --jitter 0 --turn 10). The service runs on a free port
    of this machine; bare calls and the service take turns, so that other load disturbs both. With
    --soak-min, the memory of the service over so many minutes at a steady rate instead, and how
    far its medians differ.
    """
    if soak_min:
        soak.command(model, scene, soak_min, rate_hz, soak_log)
    cv2.setNumThreads(1)
    loop = Loop(scene)
    overhead(loop, model)
    many(loop, model, scene)
