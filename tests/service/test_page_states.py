"""The page in every state, good and bad, at two widths: pictures to look at, and its layout."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from tests.service.page_feed import SIZES, text_has, until, word_is
from tests.waiting import MOST_S, wait_until

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.io.sequences import BopSceneWriter
from rendezview_service.client import Client
from rendezview_service.messages.model_messages import JobInfo
from rendezview_service.tracker.tracking import camera_message

pytest.importorskip("playwright", reason="the page's tests want playwright")

_STEP_S = 5.0  # between frames of the tour: a slow turn
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


@pytest.fixture
def sender(service, camera, tour) -> Iterator[Callable[..., Sender]]:
    opened: list[Sender] = []

    def start(name: str, url: str = service.url, **more: Any) -> Sender:
        images = [image for _, _, image in tour]
        images += images[-2:0:-1]
        request = {"prior": tour[0][1], "name": name, "idle_s": 600.0} | more
        opened.append(Sender(url, images, camera, **request))
        opened[-1].start()
        return opened[-1]

    yield start
    for one in opened:
        one.stop()


def test_found_with_the_numbers_of_an_approach(service, sender, open_page, shoot) -> None:
    one = sender("approach", approach=APPROACH)
    page = open_page(f"{service.url}#approach")
    one.send(8)
    word_is(page, "FOUND")
    until(page, "rendezview.spaces > 0 && document.querySelectorAll('#plots canvas').length === 8")
    text_has(page, "#approach", "roll pitch yaw")
    assert "± 3σ" in page.inner_text("#numbers caption")
    text_has(page, "#when", "UTC · T+")
    text_has(page, "#totals", one.state["model_sha256"][:12])
    text_has(page, "#alerts", "less than 9.5 m")
    text_has(page, "#events", "range")
    shoot(page, "found")
    state = one.hold()
    text_has(page, "#approach", f"{state['approach']['range_m']:.3f}")


def test_old_numbers_are_grey_with_their_age_and_come_back_after_a_reload(
    service, sender, open_page, shoot
) -> None:
    one = sender("stale")
    page = open_page(f"{service.url}#stale")
    one.send(4)
    word_is(page, "FOUND")
    one.hold()
    word_is(page, "NO FRAMES")
    assert page.evaluate("document.body.classList.contains('stale')")
    age = page.inner_text("#live .age")
    assert age.endswith("s old")
    shoot(page, "no-frames")
    page.reload()
    word_is(page, "NO FRAMES")
    text_has(page, "#frame-note", "frame")
    text_has(page, "#numbers", "px")
    assert float(page.inner_text("#live .age").split()[0]) >= float(age.split()[0])
    # The picture is there too, not a dark canvas.
    brightest = """(() => {
      const canvas = document.getElementById('frame');
      const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      return data.reduce((most, value, k) => (k % 4 === 0 ? Math.max(most, value) : most), 0);
    })()"""
    until(page, f"{brightest} > 60")
    shoot(page, "reloaded")


def test_coasting_shows_a_prediction_that_widens_and_lost_shows_none(
    service, sender, open_page, shoot
) -> None:
    one = sender("coasting")
    page = open_page(f"{service.url}#coasting")
    one.send(6)
    word_is(page, "FOUND")
    one.hold()
    one.time_s += 0.01 - one.step_s
    one.image, one.step_s = np.zeros_like(one.images[0]), 0.01
    first = one.send(1)
    assert first["phase"] == "coasting"
    later = one.send(4)
    sigma = [np.sqrt(np.diag(s["motion"]["covariance"])) for s in (first, later)]
    assert np.all(sigma[1] > sigma[0])
    word_is(page, "COASTING")
    text_has(page, "#numbers caption", "Predicted")
    until(page, "document.getElementById('approach').className === 'predicted'")
    shoot(page, "coasting")
    last = one.hold()
    assert last["phase"] == "coasting"
    for value in last["motion"]["pose"]["translation_m"]:
        text_has(page, "#numbers", f"{abs(value):.3f}")
    one.step_s = 60.0
    one.send(3)
    word_is(page, "LOST")
    text_has(page, "#numbers", "–")
    shoot(page, "lost")


def test_ambiguous_names_the_poses_that_fit(service, sender, open_page, shoot) -> None:
    """Two poses that fit equally are rare: a found state is changed on its way to the page."""
    rivals = {"pose": None, "phase": "searching", "status": "ambiguous", "reason": "two poses fit"}

    def changed(socket: Any) -> None:
        server = socket.connect_to_server()

        def pass_on(message: str | bytes) -> None:
            told = json.loads(message) if isinstance(message, str) else {}
            if told.get("type") == "state" and told["state"]["pose"] is not None:
                pose = told["state"]["pose"]
                told["state"] |= rivals | {"candidates": [pose, pose], "approach": None}
                message = json.dumps(told | {"contour": None})
            socket.send(message)

        server.on_message(pass_on)

    one = sender("ambiguous")
    page = open_page(service.url)
    page.route_web_socket("**/watch*", changed)
    page.goto(f"{service.url}?again#ambiguous")
    one.send(4)
    word_is(page, "AMBIGUOUS")
    text_has(page, "#reason", "2 poses fit")
    text_has(page, "#numbers", "–")
    shoot(page, "ambiguous")


def test_a_session_that_ends_and_others_at_a_glance(service, sender, open_page, shoot) -> None:
    one, other = sender("ending"), sender("other")
    one.send(2)
    other.send(2)
    page = open_page(f"{service.url}#ending")
    word_is(page, "FOUND")
    text_has(page, "#strip", "other · tracking")
    one.stop()
    word_is(page, "ENDED")
    shoot(page, "ended")
    page.reload()
    word_is(page, "ENDED")
    text_has(page, "#reason", "session ending has ended: closed by a request")
    text_has(page, "#link", "session ended")
    page.click("#strip button:has-text('other')")
    until(page, "location.hash === '#other'")
    word_is(page, "FOUND")


def test_a_session_that_is_not_there_yet_is_waited_for_and_no_other_is_shown(
    service, sender, open_page, shoot
) -> None:
    sender("present").send(2)
    page = open_page(f"{service.url}#later")
    word_is(page, "NO SESSION")
    text_has(page, "#reason", "“later” is not there (yet)")
    text_has(page, "#strip", "present · tracking")
    assert page.input_value("#sessions") == ""
    assert page.evaluate("rendezview.received") == 0
    shoot(page, "no-session")
    sender("later").send(2)
    word_is(page, "FOUND")
    assert page.input_value("#sessions") == "later"
    page.evaluate("location.hash = 'never'")
    word_is(page, "NO SESSION")
    text_has(page, "#numbers", "–")
    assert page.is_visible("#space-note")


def test_a_full_disk_is_said_without_bursting_the_layout(service, sender, open_page, shoot) -> None:
    one = sender("fulldisk")
    page = open_page(f"{service.url}#fulldisk")
    one.send(2)
    text_has(page, "#recording", "● recording")
    with service.full_disk():
        text_has(page, "#alerts", "NOT RECORDED")
        text_has(page, "#alerts", "cannot be written")
        text_has(page, "#recording", "failed")
        assert "bad" in page.get_attribute("#recording", "class")
        word_is(page, "FOUND")  # it is tracked all the same
        shoot(page, "full-disk")
    text_has(page, "#recording", "● recording")


def test_a_dead_service_and_one_that_came_back_without_the_session(
    start_service, sender, open_page, shoot, tmp_path, camera
) -> None:
    """The second one has a source that cannot be opened, which says why."""
    served = start_service("--record", str(tmp_path))
    port = served.url.rstrip("/").rpartition(":")[2]
    one = sender("killed", served.url)
    page = open_page(f"{served.url}#killed", tolerates="net::ERR_|WebSocket connection")
    one.send(3)
    word_is(page, "FOUND")
    until(page, "rendezview.spaces > 0 && document.querySelectorAll('#plots canvas').length === 8")
    served.kill()
    word_is(page, "NO CONNECTION")
    text_has(page, "#reason", "cannot be reached for")
    until(page, "document.body.classList.contains('stale')")
    until(page, "rendezview.plotted === rendezview.frame")  # the last frames too
    shoot(page, "dead-service")
    file = tmp_path / "camera.yaml"
    save_camera(camera, file)
    source = ("--source", "rtsp://127.0.0.1:9/none", "--camera", str(file))
    again = start_service("--port", port, "--record", str(tmp_path), *source)
    word_is(page, "ENDED")
    text_has(page, "#reason", "not there any more")
    shoot(page, "restarted-service")
    page.click("#strip button:has-text('main')")
    word_is(page, "NO SOURCE")
    text_has(page, "#reason", "Connection refused")
    shoot(page, "no-source")
    page.close()
    again.stop()  # it would try its source for ever


def test_a_recording_is_looked_back_at(service, client, sender, open_page, shoot) -> None:
    one = sender("viewed", approach=APPROACH)
    one.send(6)
    page = open_page(f"{service.url}#viewed")
    word_is(page, "FOUND")
    one.hold()
    third = client.session("viewed").history()[2]
    since_s = third["received_unix_s"] - client.session("viewed").info()["created_unix_s"]
    one.stop()
    page.keyboard.press("r")
    text_has(page, "#recordings-list", "viewed-")
    shoot(page, "recordings")
    look = page.locator("#recordings-list button", has_text="Look").first
    assert look.bounding_box()["x"] + look.bounding_box()["width"] < SIZES["phone"][0]
    page.click("#recordings-list tr:has-text('viewed-') button:has-text('Look')")
    until(page, "document.getElementById('frame-note').textContent === 'frame 0'")
    # Before any step: the camera in space, and what happened.
    text_has(page, "#space-scale", "camera position")
    text_has(page, "#events", "phase: tracking (ok, frame 0)")
    text_has(page, "#events", "alarm: range")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    until(page, f"document.getElementById('frame-note').textContent === 'frame {third['frame']}'")
    text_has(page, "#approach", f"{third['approach']['range_m']:.3f}")
    text_has(page, "#when", f"T+00:{int(since_s // 60):02d}:{int(since_s % 60):02d}")
    until(page, "document.querySelectorAll('#plots canvas').length === 8")
    shoot(page, "recording")
    with page.expect_download() as waiting:
        page.keyboard.press("r")
        page.click("#recordings-list tr:has-text('viewed-') button:has-text('Download')")
    assert Path(waiting.value.path()).read_bytes().startswith(b"\x89MCAP0\r\n")


def test_models_are_sent_from_the_page(service, client, open_page, shoot, model_path) -> None:
    page = open_page(service.url)
    page.keyboard.press("m")
    text_has(page, "#models-list", "bumpy")
    page.set_input_files(
        "#model-file", {"name": "a.stl", "mimeType": "model/stl", "buffer": b"not a mesh"}
    )
    page.fill("#model-name", "wrong")
    page.click("#model-send")
    text_has(page, "#jobs", "wrong")
    page.set_input_files("#model-file", model_path)
    assert page.input_value("#model-name") == "wrong"  # as it was typed
    page.fill("#model-name", "sent")
    page.click("#model-send")
    text_has(page, "#models-note", "sent is here")
    text_has(page, "#models-list", "sent")
    shoot(page, "models")
    text_has(page, "#jobs", "failed")  # its process has ended
    client.request("DELETE", "/v1/models/sent")


def test_a_picture_is_zoomed_and_so_are_the_plots(service, sender, open_page, shoot) -> None:
    one = sender("zoomed")
    page = open_page(f"{service.url}#zoomed")
    one.send(6)
    until(page, "document.querySelectorAll('#plots canvas').length === 8")
    one.hold()
    page.hover("#frame")
    before = page.evaluate("document.getElementById('frame').toDataURL()")
    page.mouse.wheel(0, -600)
    until(page, f"document.getElementById('frame').toDataURL() !== {before!r}")
    box = page.locator("#plots .u-over").nth(1).bounding_box()
    page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.99 * box["width"], box["y"] + 25, steps=4)
    page.mouse.up()
    until(page, "!document.getElementById('unzoom').hidden")
    shoot(page, "zoomed")
    page.keyboard.press("z")
    until(page, "document.getElementById('unzoom').hidden")


def test_the_description_of_the_api_can_be_tried(service, open_page) -> None:
    page = open_page(f"{service.url}docs")
    text_has(page, "#api", "/v1/sessions/{name}/frames")
    text_has(page, "#api", "Authorize")


def test_a_training_has_the_camera_that_is_given_and_says_what_is_odd(
    service, client, open_page, shoot, tmp_path
) -> None:
    """Of two files the second gives the name; mesh and camera are both questioned."""
    mesh, camera = tmp_path / "second.stl", tmp_path / "camera.yaml"
    trimesh.creation.box((100.0, 50.0, 30.0)).export(mesh)  # m: as large as a space station
    save_camera(Camera(640, 480, 60_000.0, 60_000.0, 319.5, 239.5), camera)  # of 0.6 degrees
    page = open_page(service.url)
    page.keyboard.press("m")
    named = {"name": "first.stl", "mimeType": "model/stl", "buffer": b"solid"}
    page.set_input_files("#model-file", named)
    assert page.input_value("#model-name") == "first"
    page.set_input_files("#model-file", mesh)
    assert page.input_value("#model-name") == "second"
    page.set_input_files("#model-camera", camera)
    page.select_option("#model-order", "2")
    page.click("#model-send")
    text_has(page, "#jobs", "Check: camera: the field of view is 0.61°")
    text_has(page, "#jobs", "the size of a space station")
    shoot(page, "training")
    page.click("#jobs button:has-text('Cancel')")
    text_has(page, "#jobs", "second: cancelled")
    job = client.request("GET", "/v1/jobs")["jobs"][0]
    assert len(JobInfo.model_validate(job).warnings) == 2


def test_a_doubtful_camera_is_questioned_unless_it_is_meant(
    service, client, open_page, shoot
) -> None:
    narrow = Camera(640, 480, 60_000.0, 60_000.0, 319.5, 239.5)
    keys = camera_message(narrow).model_dump(mode="json")
    meant = {"id": "meant", "camera": keys | {"checked": True}}
    assert client.request("POST", "/v1/sessions", json.dumps(meant).encode())["warnings"] == []
    with client.open(narrow, name="doubtful") as session:
        (said,) = session.info()["warnings"]
        assert said.startswith("camera: the field of view is 0.61°")
        assert said.endswith('("checked": true in the camera if it is meant)')
        page = open_page(f"{service.url}#doubtful")
        text_has(page, "#alerts", f"Check: {said}")
        text_has(page, "#events", f"session: {said}")
        shoot(page, "doubt")
        page.click("#strip button:has-text('meant')")
        until(page, "document.getElementById('alerts').hidden")
    client.session("meant").close()


def test_a_source_that_has_ended_says_so_after_a_reload(
    start_service, open_page, shoot, camera, tour, tmp_path
) -> None:
    scene = tmp_path / "scene"
    with BopSceneWriter(scene, camera) as writer:
        for k, (_, pose, image) in enumerate(tour[:4]):
            writer.add(k, image, pose, 5.0 * k)
    served = start_service("--source", str(scene), "--speed", "0")
    with served.client() as client:
        wait_until(lambda: client.session("main").info()["finished"])
        last = client.session("main").state()
    asked: list[str] = []
    page = open_page("about:blank")
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{served.url}#main")
    for _ in range(2):
        word_is(page, "ENDED")
        text_has(page, "#reason", f"the source has ended: {scene} · 4 frames, 100 % with a pose")
        text_has(page, "#events", f"source: ended: no frames are left in {scene}")
        text_has(page, "#approach", f"{last['approach']['range_m']:.3f}")
        text_has(page, "#frame-note", "frame 3")
        page.reload()
    # However long ago it ended: all that the service keeps.
    (history,) = {url for url in asked if "/history" in url}
    assert "seconds=1e6" in history
    shoot(page, "ended-source")
    page.close()
    served.stop()


def test_a_service_that_pauses_is_not_called_connected(
    start_service, sender, open_page, shoot, tmp_path
) -> None:
    served = start_service()
    one = sender("paused", served.url)
    page = open_page(f"{served.url}#paused")
    one.send(3)
    text_has(page, "#link", "● connected")
    os.kill(served.process.pid, signal.SIGSTOP)
    try:
        text_has(page, "#link", "no connection")
        word_is(page, "NO CONNECTION")
        text_has(page, "#reason", "the service does not answer for")
        shoot(page, "paused-service")
    finally:
        os.kill(served.process.pid, signal.SIGCONT)
    text_has(page, "#link", "● connected")
    text_has(page, "#events", "connection: none for")
    word_is(page, "FOUND")
    one.stop()
    page.close()
    served.stop()


def test_a_connection_that_died_without_a_word_is_made_again(service, sender, open_page) -> None:
    """Its first socket goes silent; the list of sessions has newer frames."""
    one = sender("silent-socket")
    sockets: list[Any] = []

    def through(socket: Any) -> None:
        sockets.append(socket)
        server = socket.connect_to_server()
        first = len(sockets) == 1
        server.on_message(lambda message: None if first else socket.send(message))

    page = open_page(service.url)
    page.route_web_socket("**/watch*", through)
    page.goto(f"{service.url}?again#silent-socket")
    one.send(4)
    until(page, "rendezview.received > 0")
    assert len(sockets) >= 2
    word_is(page, "FOUND")


# Text that is hard to read: less contrast than 4.5 : 1 (WCAG 2, AA) with what is behind it.
_CONTRAST = """() => {
  const channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
    .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, k) => sum + [0.2126, 0.7152, 0.0722][k] * v, 0);
  const behind = (part) => {
    for (let at = part; at; at = at.parentElement) {
      const [r, g, b, a = 1] = channels(getComputedStyle(at).backgroundColor);
      if (a > 0.7) return [r, g, b];
    }
  };
  const faults = [];
  for (const part of document.querySelectorAll('body *')) {
    const own = [...part.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    if (!own || !part.getClientRects().length || part.closest('noscript')) continue;
    const both = [light(channels(getComputedStyle(part).color)), light(behind(part))];
    const ratio = (Math.max(...both) + 0.05) / (Math.min(...both) + 0.05);
    if (ratio < 4.5) faults.push(`${part.id || part.tagName} ${part.textContent}: ${ratio}`);
  }
  return faults;
}"""


def test_light_and_dark_are_readable_and_the_operator_chooses(
    service, sender, open_page, shoot
) -> None:
    one, other = sender("theme", approach=APPROACH), sender("theme-other")
    one.send(4)
    other.send(2)
    page = open_page(f"{service.url}#theme", color_scheme="dark")
    word_is(page, "FOUND")
    until(page, "document.querySelectorAll('#plots canvas').length === 8")
    text_has(page, "#alerts", "less than 9.5 m")
    ground = "getComputedStyle(document.documentElement).backgroundColor"
    dark = page.evaluate(ground)
    assert page.evaluate(_CONTRAST) == []
    page.keyboard.press("l")
    until(page, f"{ground} !== {dark!r}")
    assert page.evaluate(_CONTRAST) == []
    shoot(page, "light")
    page.reload()  # it is remembered
    word_is(page, "FOUND")
    assert page.evaluate(ground) != dark
    for key, dialog in (("?", "help"), ("m", "models"), ("r", "recordings")):
        page.keyboard.press(key)
        until(page, "document.querySelector('dialog[open]')")
        assert page.evaluate(_CONTRAST) == []
        shoot(page, f"light-{dialog}")
        page.keyboard.press("Escape")
    page.click("#theme")
    until(page, f"{ground} === {dark!r}")
    shoot(page, "dark")
    page.emulate_media(color_scheme="light")  # the choice has precedence
    assert page.evaluate(ground) == dark
    page.evaluate("localStorage.clear()")
    page.reload()
    until(page, f"{ground} !== {dark!r}")
