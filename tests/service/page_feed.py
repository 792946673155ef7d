"""Frames for the page's tests, waiting for what it shows, and pictures of it."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from tests.waiting import MOST_S, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.client import Client

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


APPROACH = {
    "port": {"centre_m": [-1.0, 0.0, 0.0], "axis": [-1.0, 0.0, 0.0]},
    "corridor": {"half_angle_deg": 15.0, "radius_m": 0.3, "length_m": 12.0},
    "keep_out_m": 6.0,
    "limits": [{"quantity": "range_m", "least": 9.5}],
    "plan": [
        {"time_s": 0.0, "position_m": [-12.0, 0.0, 0.0]},
        {"time_s": 200.0, "position_m": [-2.0, 0.0, 0.0]},
    ],
}
_STEP_S = 5.0  # between frames of the tour of a `Sender`: a slow turn


class Sender(threading.Thread):
    """Frames of the tour to a session, a few a second, until it is held."""

    def __init__(self, url: str, images: list[np.ndarray], camera: Any, **request: Any) -> None:
        super().__init__(daemon=True)
        self.images, self.step_s = images, _STEP_S
        self.image: np.ndarray | None = None  # sent in place of the tour's
        self.state: dict[str, Any] = {}
        self.count, self.time_s = 0, 0.0
        self._url, self._camera, self._request = url, camera, request
        self._going, self._done, self._opened = (threading.Event() for _ in range(3))
        self._between = threading.Lock()

    def run(self) -> None:
        with Client(self._url, timeout_s=MOST_S, reconnect_s=0.0) as client:
            session = client.open(self._camera, **self._request)
            self._opened.set()
            while not self._done.is_set():
                if not self._going.wait(0.05):
                    continue
                with self._between:
                    if not self._going.is_set():  # held between the two lines above
                        continue
                    image = self.images[self.count % len(self.images)]
                    try:
                        shown = image if self.image is None else self.image
                        self.state = session.track(shown, self.time_s)
                    except RendezviewError:
                        return  # the service is gone
                    self.count += 1
                    self.time_s += self.step_s
                time.sleep(0.15)
            with contextlib.suppress(RendezviewError):
                session.close()

    def send(self, count: int = 1) -> dict[str, Any]:
        """The state after some more frames; they go on."""
        assert self._opened.wait(MOST_S)
        wanted = self.count + count
        self._going.set()
        wait_until(lambda: self.count >= wanted)
        return self.state

    def hold(self) -> dict[str, Any]:
        """No more frames for now; the last state."""
        self._going.clear()
        with self._between:
            return self.state

    def stop(self) -> None:
        """The session ends."""
        self._done.set()
        self.join(MOST_S)
