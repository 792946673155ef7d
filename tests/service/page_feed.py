"""Frames for the page's tests, waiting for what it shows, and pictures of it."""

from __future__ import annotations

import os
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from tests.waiting import wait_until

from rendezview_service.client import SessionClient

SIZES = {"desk": (1400, 900), "phone": (390, 844)}
_DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(0))))"
# What must be in the window at both widths: nothing hangs over the side, and words are not cut.
_LAYOUT = """(wide) => {
  const faults = [], window_ = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > window_) faults.push('the page is wider than the window');
  for (const part of document.querySelectorAll('header *, #banner, #word, #alerts li, #strip *, main > *, footer, footer *')) {
    const box = part.getBoundingClientRect();
    if (!box.width || part.matches('option')) continue;
    if (box.right > window_ + 1 || box.left < -1) faults.push(`${part.id || part.tagName}: ${box.left} … ${box.right}`);
  }
  if (wide) for (const id of ['word', 'approach', 'frame', 'plots', 'pause']) {
    const box = document.getElementById(id).getBoundingClientRect();
    if (box.top < 0 || (id !== 'approach' && box.bottom > innerHeight + 1)) faults.push(`${id} is outside the window`);
  }
  return faults;
}"""  # noqa: E501


def browser_path(play: Any) -> str | None:
    """RENDEZVIEW_TEST_BROWSER, the system's Chromium, or the one that playwright installs.

    With RENDEZVIEW_TEST_BROWSER=none there is none.
    """
    given = os.environ.get("RENDEZVIEW_TEST_BROWSER")
    if given == "none":
        return None
    names = ("chromium", "chromium-browser", "google-chrome")
    own = play.chromium.executable_path
    found = given or next(filter(None, map(shutil.which, names)), None)
    return found or (own if Path(own).exists() else None)


def until(page: Any, expression: str) -> Any:
    """The value of an expression, once it is true: the page's own policy forbids to wait in it."""
    return wait_until(
        lambda: page.evaluate(expression),
        lambda: f"never came true: {expression}; the page says {page.inner_text('#banner')!r}",
    )


def word_is(page: Any, word: str) -> None:
    until(page, f"document.getElementById('word').textContent === '{word}'")


def text_has(page: Any, place: str, part: str) -> None:
    until(page, f"document.querySelector('{place}').innerText.includes({part!r})")


def shoot(page: Any, folder: Path | None, name: str) -> None:
    """At both widths the layout of a page must hold; pictures of it, if there is a folder."""
    for size, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.evaluate(_DRAWN)
        if folder is not None:
            time.sleep(0.1)  # and the view in space, which is drawn less often
            page.screenshot(path=folder / f"{name}-{size}.png", full_page=size == "phone")
        assert page.evaluate(_LAYOUT, size == "desk") == [], name


class Feed:
    """Frames of a tour to and fro, at some a second, until it is told otherwise."""

    def __init__(self, session: SessionClient, images: list[np.ndarray], rate_hz: float = 20.0):
        self.images = images
        self.step_s = 0.1  # of the frames' own time
        self._done = threading.Event()
        self._stream = session.stream()
        self._rate_hz = rate_hz
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with self._stream as stream:
            k, time_s = 0, 0.0
            while not self._done.wait(1.0 / self._rate_hz):
                images = self.images
                stream.send(images[k % len(images)], time_s)
                stream.receive()
                k, time_s = k + 1, time_s + self.step_s

    def stop(self) -> None:
        self._done.set()
        self._thread.join()
