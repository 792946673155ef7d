"""Memory of the service's processes over many frames, recording and history on."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import cv2
from rendezview.client import Client

from experiments.service.serving import Loop, Served
from rendezview.geometry.camera import Camera

_POINTS = 10


def open_files(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def shrunk(loop: Loop, by: int) -> Loop:
    """The same frames with pixels ``by`` times as large."""
    c = loop.camera
    width, height = c.width // by, c.height // by
    loop.camera = Camera(
        width, height, c.fx / by, c.fy / by, (c.cx + 0.5) / by - 0.5, (c.cy + 0.5) / by - 0.5
    )
    loop.images = [
        cv2.resize(
            image[: by * height, : by * width], (width, height), interpolation=cv2.INTER_AREA
        )
        for image in loop.images
    ]
    return loop


def run(
    model: Path, scene: Path, *, frames: int = 100000, history_s: float = 10.0, shrink: int = 5,
    rate_hz: float = 0.0,
) -> None:  # fmt: skip
    """Memory of the service's processes over many frames, recording and history on.

    SCENE's frames run forward and backward, shrunk (--shrink) so that the count is reached in
    minutes: a leak would grow with the number of frames. Half of them go by requests, half by a
    stream, and one in 500 to a session that is opened for it and closed. With a short history
    (--history-s) memory is full soon, and later growth is a leak. With --rate-hz they go at that
    rate, for a long run; else as fast as they are answered.
    """
    loop = shrunk(Loop(scene), shrink)
    # All frames come from one address, faster than any camera.
    settings = {"history_s": history_s, "record_model": "false", "requests_per_s": 1_000_000}
    with tempfile.TemporaryDirectory() as folder:
        served = Served(model, "--workers", "2", "--record", folder, **settings)
        served.await_ready()
        pids = served.pids()
        names = ["service", *(f"worker {k}" for k in range(1, len(pids)))]
        size = f"{loop.camera.width} × {loop.camera.height} px"
        print(f"{size}, history {history_s:g} s, half of the frames by requests")
        print(f"{'frames':>8} {'s':>5} " + " ".join(f"{n + ' MB':>12}" for n in names), "files")
        start_s = time.monotonic()

        def tell(done: int) -> None:
            sizes = " ".join(f"{mb:12.1f}" for mb in served.each_mb())
            files = [open_files(pid) for pid in pids]
            print(f"{done:8} {time.monotonic() - start_s:5.0f} {sizes}", *files, flush=True)

        try:
            with Client(served.url) as client:
                by_request, streaming = (
                    client.open(loop.camera, prior=loop.prior) for _ in range(2)
                )
                with streaming.stream() as stream:
                    found = 0
                    tell(0)
                    each = max(1, frames // _POINTS)
                    for k in range(1, frames + 1):
                        time_s, image = loop(k)
                        if rate_hz > 0.0:
                            time.sleep(max(0.0, start_s + k / rate_hz - time.monotonic()))
                        if k % 500 == 0:
                            once = client.open(loop.camera, prior=loop.prior)
                            once.track(image, 0.0)
                            once.close()
                        elif k % 2:
                            found += by_request.track(image, time_s)["pose"] is not None
                        else:
                            stream.send(image, time_s)
                            found += stream.receive(30.0)["pose"] is not None
                        if k % each == 0:
                            tell(k)
                print(f"{found} poses")
                logs_mb = sum(p.stat().st_size for p in Path(folder).glob("*.mcap")) / 1e6
                print(f"logs: {logs_mb:.0f} MB in {len(list(Path(folder).glob('*.mcap')))} files")
        finally:
            served.stop()
