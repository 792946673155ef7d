"""Load time and update rate of the page."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import statistics
import threading
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright
from rendezview.client import Client
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from experiments.service.serving import Loop, Served
from rendezview.errors import RendezviewError

RATE_HZ = 30.0


def stream(url: str, loop: Loop, done: threading.Event) -> None:
    """Frames at 30 a second until `done` is set; answers are discarded."""
    with (
        Client(url) as client,
        client.open(loop.camera, prior=loop.prior, name="page").stream() as frames,
    ):

        def read() -> None:
            with contextlib.suppress(RendezviewError):
                while True:
                    frames.receive()

        threading.Thread(target=read, daemon=True).start()
        start_s, k = time.monotonic(), 0
        while not done.is_set():
            frames.send(loop(k)[1], k / RATE_HZ)
            k += 1
            time.sleep(max(0.0, start_s + k / RATE_HZ - time.monotonic()))


class Peer:
    """Watches as the page does, pictures too, and only counts."""

    def __init__(self, url: str) -> None:
        self.count = 0
        address = url.replace("http", "ws", 1).rstrip("/") + "/v1/sessions/page/watch?rate_hz=30"
        self._socket = connect(address, max_size=None)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in self._socket:
                self.count += isinstance(message, str)


def value(page: Page, expression: str, most_s: float = 20.0) -> Any:
    """Of an expression, as soon as it is something."""
    end_s = time.monotonic() + most_s
    while time.monotonic() < end_s:
        if (found := page.evaluate(expression)) is not None:
            return found
        time.sleep(0.02)
    raise SystemExit(f"the page does not come so far: {expression}")


def first_use_ms(browser: Browser, url: str) -> float:
    """Of a page that is new to the browser."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    page.goto(url, wait_until="commit")
    at_ms = value(page, 'performance.getEntriesByName("useful")[0]?.startTime ?? null')
    context.close()
    return float(at_ms)


def run(
    model: Path, scene: Path, *, loads: int = 7, seconds: int = 30, screenshot: Path | None = None,
    browser: str | None = shutil.which("chromium"),
) -> None:  # fmt: skip
    """Load time and update rate of the page.

    SCENE is a folder that rendezview simulate wrote, 640 × 480, of the model's target. A service on
    a free port receives the scene as a stream of 30 frames a second; a Chromium without a window
    watches it at 1280 × 800. The page is useful when a camera image, the status word and the pose
    are drawn; the time counts from the start of the navigation, with an empty cache. A plain
    watcher without a browser counts the states that the service sends.
    """
    served = Served(model, "--workers", "1")
    done = threading.Event()
    feeder = threading.Thread(target=stream, args=(served.url, Loop(scene), done), daemon=True)
    feeder.start()
    flags = ["--disable-gpu", "--enable-unsafe-swiftshader"]
    if os.geteuid() == 0:
        flags.append("--no-sandbox")
    try:
        with sync_playwright() as play:
            chromium = play.chromium.launch(executable_path=browser, args=flags)
            with Client(served.url) as client:
                while not any(one["frames"] for one in client.sessions()):
                    time.sleep(0.1)
            first_ms = sorted(first_use_ms(chromium, served.url) for _ in range(loads))
            print(f"load of the machine {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")
            print(
                f"first useful paint: median {statistics.median(first_ms):.0f} ms, "
                f"least {first_ms[0]:.0f}, most {first_ms[-1]:.0f} of {len(first_ms)}"
            )
            page = chromium.new_page(viewport={"width": 1280, "height": 800})
            page.goto(served.url)
            value(page, "rendezview.spaces > 1 ? true : null")
            peer = Peer(served.url)
            counts = []
            for _ in range(seconds + 1):
                at_ms, drawn, spaces = page.evaluate(
                    "[performance.now(), rendezview.updates, rendezview.spaces]"
                )
                counts.append((at_ms, drawn, spaces, peer.count))
                time.sleep(1.0)
            rates = sorted(
                1e3 * (after[1] - before[1]) / (after[0] - before[0])
                for before, after in itertools.pairwise(counts)
            )
            span_s = (counts[-1][0] - counts[0][0]) / 1e3
            total = [(counts[-1][k] - counts[0][k]) / span_s for k in (1, 2, 3)]
            print(
                f"updates a second over {span_s:.0f} s: {total[0]:.1f} drawn of {total[2]:.1f} "
                f"that a plain watcher was shown ({100 * total[0] / total[2]:.1f} %)"
            )
            print(
                f"of single seconds: median {statistics.median(rates):.1f}, "
                f"least {rates[0]:.1f}, most {rates[-1]:.1f}"
            )
            print(f"view in space, drawn by software: {total[1]:.1f} a second")
            if screenshot:
                page.screenshot(path=screenshot)
            chromium.close()
    finally:
        done.set()
        feeder.join(5.0)
        served.stop()
