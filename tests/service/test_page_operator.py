"""The page for who operates: doubts, ends, pauses, and light and dark."""

from __future__ import annotations

import json
import os
import signal
from typing import Any

import pytest
import trimesh
from tests.service.page_feed import APPROACH, text_has, until, word_is
from tests.waiting import wait_until

from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_service.messages.model_messages import JobInfo
from rendezview_service.tracker.tracking import camera_message

pytest.importorskip("playwright", reason="the page's tests want playwright")


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


def test_a_service_that_pauses_is_not_called_connected(service, sender, open_page, shoot) -> None:
    one = sender("paused")
    page = open_page(f"{service.url}#paused")
    one.send(3)
    text_has(page, "#link", "● connected")
    os.kill(service.process.pid, signal.SIGSTOP)
    try:
        text_has(page, "#link", "no connection")
        word_is(page, "NO CONNECTION")
        text_has(page, "#reason", "the service does not answer for")
        shoot(page, "paused-service")
    finally:
        os.kill(service.process.pid, signal.SIGCONT)
    text_has(page, "#link", "● connected")
    text_has(page, "#events", "connection: none for")
    word_is(page, "FOUND")


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
