"""Memory of the service's processes over many frames, recording and history on.

    python scripts/service_memory.py hubble.rvm [--frames 100000] [--side 64]

Frames are small (side × side pixels, a bright block that wanders before a noisy sky), so that the
count is reached in minutes: what would leak, it would leak by the frame. Half of them go by
requests, half by a stream, and one in 500 to a session that is opened for it and closed. With
--history-s (10) the last seconds are full soon, and what grows after that is a leak.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from rendezview.camera import Camera
from rendezview.client import Client
from service_speed import Served

_POINTS = 10


def resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def open_files(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--side", type=int, default=64)
    parser.add_argument("--history-s", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    side = arguments.side
    camera = Camera.from_fov(side, side, np.deg2rad(40.0))
    images = []
    for k in range(32):
        image = rng.integers(0, 12, (side, side), dtype=np.uint8)
        row, column = (int(side * (0.3 + 0.1 * f(k / 5.0))) for f in (np.sin, np.cos))
        image[row : row + side // 3, column : column + side // 4] = 180
        images.append(image)
    os.environ["RENDEZVIEW_SERVE_HISTORY_S"] = str(arguments.history_s)
    os.environ["RENDEZVIEW_SERVE_RECORD_MODEL"] = "false"
    # All come from one address, faster than any camera.
    os.environ["RENDEZVIEW_SERVE_REQUESTS_PER_S"] = "1000000"
    with tempfile.TemporaryDirectory() as folder:
        served = Served(arguments.model, "--workers", "2", "--record", folder)
        pids = served.pids()
        names = ["service", *(f"worker {k}" for k in range(1, len(pids)))]
        print(f"seed {arguments.seed}, {side} × {side} px, history {arguments.history_s:g} s")
        print(f"{'frames':>8} {'s':>5} " + " ".join(f"{n + ' MB':>12}" for n in names), "files")
        start_s = time.monotonic()

        def tell(done: int) -> None:
            sizes = " ".join(f"{resident_mb(pid):12.1f}" for pid in pids)
            files = [open_files(pid) for pid in pids]
            print(f"{done:8} {time.monotonic() - start_s:5.0f} {sizes}", *files, flush=True)

        try:
            with Client(served.url) as client:
                by_request, streaming = client.open(camera), client.open(camera)
                with streaming.stream() as stream:
                    tell(0)
                    each = max(1, arguments.frames // _POINTS)
                    for k in range(1, arguments.frames + 1):
                        image = images[k % len(images)]
                        if k % 500 == 0:
                            once = client.open(camera)
                            once.track(image, 0.0)
                            once.close()
                        elif k % 2:
                            by_request.track(image, 0.01 * k)
                        else:
                            stream.send(image, 0.01 * k)
                            stream.receive(30.0)
                        if k % each == 0:
                            tell(k)
                logs_mb = sum(p.stat().st_size for p in Path(folder).glob("*.mcap")) / 1e6
                print(f"logs: {logs_mb:.0f} MB in {len(list(Path(folder).glob('*.mcap')))} files")
        finally:
            served.stop()


if __name__ == "__main__":
    main()
