"""A real service on a free port, and frames to send it."""

from __future__ import annotations

import asyncio
import os
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.made_once import made_once
from tests.service import approach, page_feed
from tests.service.browser import Stepwise
from tests.service.ros_node import node
from tests.service.served import Served
from tests.waiting import MOST_S, free_port

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import ViewModel
from rendezview_service.client import Client

TOUR = 24  # frames
# A test that a busy machine holds up must not run into a limit of the service.
_PATIENT = {
    "RENDEZVIEW_SERVE_SPARE_WORKER": "false",
    "RENDEZVIEW_SERVE_FRAME_TIMEOUT_S": str(MOST_S),
    "RENDEZVIEW_SERVE_IDLE_S": str(2.0 * MOST_S),
    "RENDEZVIEW_SERVE_LOG_WAIT_S": str(MOST_S),
}


Serve = Callable[..., Served]


@pytest.fixture(scope="session")
def model_path(tmp_path_factory: pytest.TempPathFactory, refining_model: ViewModel) -> Path:
    path = tmp_path_factory.mktemp("served") / "bumpy.rvm"
    refining_model.save(path)
    return path


@pytest.fixture(scope="session")
def start_service(model_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serve]:
    """Starts a service; those that still run at the end are killed."""
    started: list[Served] = []

    def start(*flags: str, given: bool = True, before: str = "", **environment: str) -> Served:
        """Without ``given`` it has no model; ``before``: a program that each process runs first."""
        folder = tmp_path_factory.mktemp("service")
        if before:
            (folder / "sitecustomize.py").write_text(before)
            places = str(folder), os.environ.get("PYTHONPATH")
            environment["PYTHONPATH"] = os.pathsep.join(filter(None, places))
        model = [str(model_path)] if given else []
        served = Served.start(
            *model, "--workers", "1", *flags, folder=folder, environment=_PATIENT | environment
        )
        started.append(served)
        return served

    yield start
    for served in started:
        if served.process.poll() is None:
            served.kill()
        served.process.communicate(timeout=MOST_S)


@pytest.fixture(scope="session")
def models_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the shared service: models that are sent, and those of its trainings."""
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="session")
def service(
    start_service: Serve, models_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Served]:
    """The one that most tests share: it records into ``folder`` of its own."""
    logs = tmp_path_factory.mktemp("logs")
    served = start_service(
        *("--record", str(logs), "--models", str(models_folder)), RENDEZVIEW_SERVE_SESSIONS="6"
    )
    served.folder = logs
    yield served
    served.stop()


@dataclass(frozen=True)
class Watched:
    """A service with all live streams: its ports, and what a ROS node has received."""

    served: Served
    foxglove: int
    rerun: int
    received: list[Any]


@pytest.fixture(scope="session")
def watched(start_service: Serve) -> Iterator[Watched]:
    for package in ("foxglove", "rerun", "zenoh"):
        pytest.importorskip(package)
    ports, endpoint = (free_port(), free_port()), f"tcp/127.0.0.1:{free_port()}"
    with node(endpoint) as received:
        flags = ("--foxglove", str(ports[0]), "--rerun", str(ports[1]), "--ros", endpoint)
        served = start_service(*flags)
        yield Watched(served, *ports, received)
        served.stop()


@pytest.fixture
def client(service: Served) -> Iterator[Client]:
    with service.client() as client:
        yield client


@pytest.fixture(scope="session")
def tour(
    refining_model: ViewModel, bumpy_mesh, camera: Camera, draw
) -> list[tuple[float, Pose, np.ndarray]]:
    """Times, true poses and frames (H, W) of a target that turns slowly; every one is found."""
    rng = np.random.default_rng(5)
    start = Rotation.from_rotvec([0.4, 1.0, 0.2])
    rate = np.deg2rad([1.0, -0.8, 0.5])  # per frame
    frames = []
    for k in range(TOUR):
        rotation = (Rotation.from_rotvec(k * rate) * start).as_matrix()
        centre = np.array([0.05 - 0.01 * k, 0.02 * k, 9.0 + 0.03 * k])
        truth = Pose(rotation, centre - rotation @ refining_model.centre_m)
        frames.append((0.1 * k, truth, draw(bumpy_mesh, truth, camera, rng)))
    return frames


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight to the client's ring, 14 m to 2 m: ``scene``, ``laser.jsonl``, ``client.rvm``."""

    def fly(folder: Path) -> None:
        folder.mkdir()
        approach.draw(folder, frames=13, seed=1, start_m=14.0, end_m=2.0)
        # A model as small as it can be: 42 views.
        smallest = "--order 0 --views 60 --held-out 0 --resolution 128 --shells 1,2 --jobs 1"
        approach.command(folder, "train", "client", "-o", "client.rvm", *smallest.split())

    return made_once(tmp_path_factory, "flown", fly)


# WebGL without a graphics card; everything else drawn as plainly as can be.
_FLAGS = ("--disable-gpu", "--enable-unsafe-swiftshader")
_DESK = {"width": 1280, "height": 800}


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A Chromium, driven by a thread of its own."""
    playwright = pytest.importorskip("playwright.async_api", reason="the page's tests want it")
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        with Stepwise(playwright.async_playwright(), loop) as play:
            path = page_feed.browser_path(play)
            if path is None:
                pytest.skip("no Chromium: playwright install chromium, or RENDEZVIEW_TEST_BROWSER")
            flags = [*_FLAGS, *(["--no-sandbox"] if os.geteuid() == 0 else [])]
            most_ms = 1e3 * MOST_S
            try:
                browser = play.chromium.launch(executable_path=path, args=flags, timeout=most_ms)
            except playwright.Error as error:
                if "RENDEZVIEW_TEST_BROWSER" in os.environ:
                    raise
                pytest.skip(f"{path} does not start: {str(error).splitlines()[0]}")
            yield browser
            browser.close()
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(MOST_S)
        loop.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens pages, each with a memory of its own; at the end none has met an error."""
    contexts, complaints = [], []

    def open_it(
        url: str, size: dict[str, int] = _DESK, script: str = "", tolerates: str = "", **more: Any
    ) -> Any:
        def note(message: Any) -> None:
            # A refused token, and a picture that is not kept, are answers that Chromium lists as
            # errors.
            known = f"401|404{'|' if tolerates else ''}{tolerates}"
            if message.type == "error" and not re.search(known, message.text):
                complaints.append(message.text)

        context = browser.new_context(viewport=size, accept_downloads=True, **more)
        context.set_default_timeout(1e3 * MOST_S)
        contexts.append(context)
        page = context.new_page()
        page.on("console", note)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        if script:
            page.add_init_script(script)
        page.goto(url)
        return page

    yield open_it
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture
def shoot() -> Callable[[Any, str], None]:
    """Checks a page at both widths; pictures go to RENDEZVIEW_TEST_PICTURES, if it is a folder."""
    named = os.environ.get("RENDEZVIEW_TEST_PICTURES")
    folder = Path(named) if named else None
    return lambda page, name: page_feed.shoot(page, folder, name)


@pytest.fixture
def sender(service, camera, tour) -> Iterator[Callable[..., page_feed.Sender]]:
    opened: list[page_feed.Sender] = []

    def start(name: str, url: str = service.url, **more: Any) -> page_feed.Sender:
        images = [image for _, _, image in tour]
        images += images[-2:0:-1]
        request = {"prior": tour[0][1], "name": name, "idle_s": 600.0} | more
        opened.append(page_feed.Sender(url, images, camera, **request))
        opened[-1].start()
        return opened[-1]

    yield start
    for one in opened:
        one.stop()
