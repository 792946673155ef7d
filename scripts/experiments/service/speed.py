"""Cost of the service over the bare tracker call, and throughput with several clients."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from multiprocessing import Queue, get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path

import cv2
import numpy as np

from experiments.service.serving import Loop, Served
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview_service.client import Client, ServiceError

ROUNDS, BLOCK = 20, 50  # blocks of frames in turns; the first warms up
CLIENTS, SECONDS = 8, 15.0  # of the throughput
ALONE_S = 8.0  # of the bare tracker, before and after


def overhead(loop: Loop, model: Path) -> None:
    """Blocks of frames in turns: bare, by requests, by a stream."""
    served = Served(model, "--workers", "1")
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
    inside_ms: dict[str, list[float]] = {name: [] for name in ways}
    for block in range(ROUNDS):
        for name, look in ways.items():
            for k in range(block * BLOCK, (block + 1) * BLOCK):
                time_s, image = loop(k)
                start = time.perf_counter()
                answer = look(image, time_s)
                if block:
                    spent_ms[name].append(1e3 * (time.perf_counter() - start))
                    inside_ms[name] += [answer["track_ms"]] if isinstance(answer, dict) else []
    stream.close()
    served.stop()
    floor = np.median(spent_ms["bare tracker call"])
    print(f"{BLOCK * (ROUNDS - 1)} frames each, 640 × 480 raw, one client:")
    for name, spent in spent_ms.items():
        low, middle = np.percentile(spent, [10, 50])
        line = f"{name:22} median {middle:6.2f} ms  best tenth {low:6.2f} ms"
        if inside_ms[name]:
            around = np.array(spent) - np.array(inside_ms[name])
            line += (
                f"  over the bare call {middle - floor:5.2f} ms; around the tracker's own time: "
                f"median {np.median(around):5.2f}, best tenth {np.percentile(around, 10):5.2f} ms"
            )
        print(line)


def run_client(url: str, scene: Path, ready: Barrier, results: Queue) -> None:
    """One client of many, in a process of its own: frames for some seconds."""
    loop = Loop(scene)
    with Client(url) as client:
        session = client.open(loop.camera, prior=loop.prior)
        ready.wait()
        start, used, done, k = time.perf_counter(), time.process_time(), 0, 0
        while time.perf_counter() < start + SECONDS:
            time_s, image = loop(k)
            k += 1
            try:
                session.track(image, time_s)
                done += 1
            except ServiceError as error:
                if error.status != 429:
                    raise
        seconds, processor_s = time.perf_counter() - start, time.process_time() - used
        session.close()
    results.put((done, seconds, processor_s))


def alone(model: ViewModel, loop: Loop, seconds: float) -> tuple[float, float]:
    """Frames a second of the bare tracker on one core, and processor milliseconds of each."""
    tracker = Tracker(Recognizer(model, loop.camera), loop.prior)
    start, used, k = time.perf_counter(), time.thread_time(), 0
    while time.perf_counter() - start < seconds:
        time_s, image = loop(k)
        tracker.update(time_s, image)
        k += 1
    return k / (time.perf_counter() - start), 1e3 * (time.thread_time() - used) / k


def many(loop: Loop, model: Path, scene: Path) -> None:
    """Throughput, fairness and memory with several clients at once."""
    loaded = ViewModel.load(model)
    alone(loaded, loop, 2.0)  # compiles
    before, before_ms = alone(loaded, loop, ALONE_S)
    served = Served(model)
    apart = get_context("spawn")
    ready, results = apart.Barrier(CLIENTS + 1), apart.Queue()
    task = (served.url, scene, ready, results)
    processes = [apart.Process(target=run_client, args=task) for _ in range(CLIENTS)]
    for process in processes:
        process.start()
    ready.wait()
    first_mb, used_s = served.resident_mb(), served.processor_s()
    frames, seconds, processor_s = np.transpose([results.get() for _ in processes])
    last_mb, service_s = served.resident_mb(), served.processor_s() - used_s
    for process in processes:
        process.join()
    served.stop()
    total, rates = int(frames.sum()), frames / seconds
    service_ms, clients_ms = 1e3 * service_s / total, 1e3 * processor_s.sum() / total
    after, after_ms = alone(loaded, loop, ALONE_S)
    alone_ms, cores = 0.5 * (before_ms + after_ms), os.cpu_count() or 1
    over = rates.sum() / (0.5 * (before + after))
    uneven = 100 * (rates.max() - rates.min()) / rates.mean()
    print(
        f"{CLIENTS} clients, {total} frames: {rates.sum():.0f} frames/s, {over:.2f} × one tracker "
        f"core's; each {rates.min():.0f} to {rates.max():.0f}, {uneven:.0f} % apart\n"
        f"one bare tracker: {before:.0f} and {after:.0f} frames/s, before and after\n"
        f"processor time a frame: bare tracker {alone_ms:.2f} ms, service and workers "
        f"{service_ms:.2f} ms, client {clients_ms:.2f} ms: {cores} cores with nothing else to do "
        f"would reach {cores * alone_ms / (service_ms + clients_ms):.2f} × with these clients, "
        f"{cores * alone_ms / service_ms:.2f} × with clients elsewhere\n"
        f"memory of all processes: {first_mb:.0f} MB at first, {last_mb:.0f} MB at the end"
    )


def run(model: Path, scene: Path) -> None:
    """Cost of the service over the bare tracker call, and throughput with eight clients.

    SCENE is a folder that rendezview simulate wrote, 640 × 480, of the model's target, moving
    little from frame to frame (--dt 0.0333 --jitter 0 --turn 10). The service runs on a free port
    of this machine; bare calls and the service take turns, so that other load disturbs both.
    """
    cv2.setNumThreads(1)
    loop = Loop(scene)
    overhead(loop, model)
    many(loop, model, scene)
