"""Cost of the service over the bare tracker call, and throughput with several clients."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np

from experiments.service.serving import Loop, Served
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview_service.client import Client, ServiceError

_BLOCK = 50


def overhead(loop: Loop, model: Path, rounds: int) -> None:
    """Blocks of frames in turns: bare, by requests, by a stream."""
    served = Served(model, "--workers", "1")
    client = Client(served.url)
    by_request = client.open(loop.camera, prior=loop.prior)
    streaming = client.open(loop.camera, prior=loop.prior)
    stream = streaming.stream()
    loaded = ViewModel.load(model)
    bare = Tracker(Recognizer(loaded, loop.camera), loop.prior)

    def streamed(image: np.ndarray, time_s: float) -> object:
        stream.send(image, time_s)
        return stream.receive(10.0)

    ways: dict[str, Callable[[np.ndarray, float], object]] = {
        "bare tracker call": lambda image, time_s: bare.update(time_s, image),
        "request (HTTP)": lambda image, time_s: by_request.track(image, time_s),
        "stream (WebSocket)": streamed,
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    inside: dict[str, list[float]] = {name: [] for name in ways}
    for block in range(rounds):
        for name, look in ways.items():
            for k in range(block * _BLOCK, (block + 1) * _BLOCK):
                time_s, image = loop(k)
                start = time.perf_counter()
                answer = look(image, time_s)
                if block:  # the first block warms up
                    times[name].append(time.perf_counter() - start)
                    if isinstance(answer, dict):
                        inside[name].append(1e-3 * answer["track_ms"])
    stream.close()
    served.stop()
    floor = np.array(times["bare tracker call"])
    print(f"{len(floor)} frames each, 640 × 480 raw, one client:")
    for name, spent in times.items():
        values = 1e3 * np.array(spent)
        extra = 1e3 * (np.median(spent) - np.median(floor))
        low, middle = np.percentile(values, [10, 50])
        line = f"{name:22} median {middle:6.2f} ms  best tenth {low:6.2f} ms"
        if inside[name]:
            around = 1e3 * (np.array(spent) - np.array(inside[name]))
            line += (
                f"  over the bare call {extra:5.2f} ms; around the tracker's own time: "
                f"median {np.median(around):5.2f}, best tenth {np.percentile(around, 10):5.2f} ms"
            )
        print(line)


def run_client(url: str, scene: Path, frames: int, out: int) -> None:
    """One client of many, in a process of its own."""
    loop = Loop(scene)
    with Client(url) as client:
        session = client.open(loop.camera, prior=loop.prior)
        os.write(out, b"ready\n")
        sys.stdin.readline()
        start, used = time.perf_counter(), time.process_time()
        done = 0
        last = start
        until_s = float("inf") if frames >= 0 else start - frames
        k = 0
        while done < frames or (frames < 0 and time.perf_counter() < until_s):
            time_s, image = loop(k)
            k += 1
            try:
                session.track(image, time_s)
            except ServiceError as error:
                if error.status != 429:
                    raise
                continue
            done += 1
            last = time.perf_counter()
        result = {"frames": done, "seconds": last - start}
        result["processor_s"] = time.process_time() - used
        session.close()
    os.write(out, json.dumps(result).encode() + b"\n")


def many(loop: Loop, model: Path, scene: Path, clients: int, frames: int) -> None:
    """Throughput, fairness and memory with several clients at once."""
    loaded = ViewModel.load(model)

    def one_core(seconds: float) -> tuple[float, float]:
        tracker = Tracker(Recognizer(loaded, loop.camera), loop.prior)
        start, used, k = time.perf_counter(), time.thread_time(), 0
        while time.perf_counter() - start < seconds:
            time_s, image = loop(k)
            tracker.update(time_s, image)
            k += 1
        return k / (time.perf_counter() - start), 1e3 * (time.thread_time() - used) / k

    one_core(2.0)
    before, before_ms = one_core(8.0)
    served = Served(model)
    each = -15 if frames == 0 else frames // clients  # below zero: seconds
    words = ["service-speed", str(model), str(scene), "--client", served.url]
    command = [sys.executable, "-m", "experiments", *words, "--frames", str(each)]
    processes = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        for _ in range(clients)
    ]
    for process in processes:
        assert process.stdout is not None
        process.stdout.readline()
    memory = [served.resident_mb()]
    used_s = served.processor_s()
    for process in processes:
        assert process.stdin is not None
        process.stdin.write(b"go\n")
        process.stdin.flush()
    start = time.perf_counter()
    results = []
    while any(process.poll() is None for process in processes):
        time.sleep(1.0)
        memory.append(served.resident_mb())
    for process in processes:
        assert process.stdout is not None
        results.append(json.loads(process.stdout.readline()))
    spent = time.perf_counter() - start
    total = sum(r["frames"] for r in results)
    rates = np.array([r["frames"] / r["seconds"] for r in results])
    throughput = float(rates.sum()) if frames == 0 else total / max(r["seconds"] for r in results)
    after_memory = served.resident_mb()
    service_ms = 1e3 * (served.processor_s() - used_s) / total
    clients_ms = 1e3 * sum(r["processor_s"] for r in results) / total
    served.stop()
    after, after_ms = one_core(8.0)
    core = 0.5 * (before + after)
    print(f"{clients} clients, {total} frames in {spent:.0f} s:")
    print(f"one bare tracker: {before:.0f} and {after:.0f} frames/s, before and after")
    print(f"service: {throughput:.0f} frames/s, {throughput / core:.2f} × one tracker core's")
    alone_ms, cores = 0.5 * (before_ms + after_ms), os.cpu_count() or 1
    print(
        f"processor time a frame: bare tracker {alone_ms:.2f} ms, service and workers "
        f"{service_ms:.2f} ms, client {clients_ms:.2f} ms: {cores} cores with nothing else to do "
        f"would reach {cores * alone_ms / (service_ms + clients_ms):.2f} × with these clients, "
        f"{cores * alone_ms / service_ms:.2f} × with clients elsewhere"
    )
    print(
        f"each client: {rates.min():.0f} to {rates.max():.0f} frames/s, "
        f"{100 * (rates.max() - rates.min()) / rates.mean():.0f} % apart"
    )
    tenth = len(memory) // 10 + 1
    print(
        f"memory of all processes: {memory[0]:.0f} MB at first, {memory[tenth]:.0f} MB after a "
        f"tenth, {memory[len(memory) // 2]:.0f} MB half way, {after_memory:.0f} MB at the end"
    )


def run(
    model: Path, scene: Path, *, clients: int = 8,
    frames: Annotated[int, "of all clients; 0: for 15 s"] = 0, rounds: int = 20,
    only: Literal["overhead", "many"] | None = None, client: str | None = None,
) -> None:  # fmt: skip
    """Cost of the service over the bare tracker call, and throughput with several clients.

    SCENE is a folder that rendezview simulate wrote, 640 × 480, of the model's target, moving
    little from frame to frame (--dt 0.0333 --jitter 0 --turn 10). The service runs on a free port
    of this machine; bare calls and the service take turns, so that other load disturbs both.
    """
    cv2.setNumThreads(1)
    if client:
        run_client(client, scene, frames, 1)
        return
    loop = Loop(scene)
    if only != "many":
        overhead(loop, model, rounds)
    if only != "overhead":
        many(loop, model, scene, clients, frames)
