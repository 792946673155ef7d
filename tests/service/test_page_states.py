"""The page in every state, good and bad, at two widths: pictures to look at, and its layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.service.page_feed import APPROACH, SIZES, text_has, until, word_is

from rendezview.io.camera_files import save_camera

pytest.importorskip("playwright", reason="the page's tests want playwright")


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
    text_has(page, "#reason", "empty: ")
    text_has(page, "#numbers", "–")
    shoot(page, "lost")
    one.image, one.step_s = None, 5.0
    one.send(1)
    word_is(page, "FOUND")


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


def test_curves_join_frames_at_the_pace_at_which_they_come(service, open_page) -> None:
    page = open_page(f"{service.url}healthz")
    holes = """async (times) => {
      const { Plots } = await import("/plots.js");
      const parent = document.body.appendChild(document.createElement("div"));
      const plots = new Plots(parent, false, () => {});
      plots.show(times.map((at, frame) => ({ frame, received_unix_s: at })), times.at(-1), 600);
      const drawn = plots._states.length;
      plots.close();
      parent.remove();
      return drawn - times.length;
    }"""
    assert page.evaluate(holes, [1000.0 + 0.1 * k for k in range(20)]) == 0
    assert page.evaluate(holes, [1000.0 + 2.0 * k for k in range(20)]) == 0
    assert page.evaluate(holes, [1000.0 + 0.1 * k for k in (0, 1, 2, 3, 20, 21, 22)]) == 1


def test_the_description_of_the_api_can_be_tried(service, open_page) -> None:
    page = open_page(f"{service.url}docs")
    text_has(page, "#api", "/v1/sessions/{name}/frames")
    text_has(page, "#api", "Authorize")
