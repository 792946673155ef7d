"""The page in a real Chromium, on a real service."""

from __future__ import annotations

import io
import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation
from tests.service.page_feed import text_has, until, word_is
from tests.waiting import wait_until

pytest.importorskip("playwright", reason="the page's tests want playwright")

_DESK, _PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


def test_the_page_shows_what_the_service_found(service, client, sender, open_page) -> None:
    session, one = client.session("seen"), sender("seen")
    one.send()
    page = open_page(f"{service.url}#seen")
    word_is(page, "FOUND")
    until(page, "rendezview.webgl && rendezview.spaces > 1 && rendezview.updates > 5")
    last = one.hold()["frame"]
    until(page, f"rendezview.frame === {last}")
    page.keyboard.press(" ")
    until(page, "document.querySelectorAll('#plots canvas').length === 8")
    # Numbers: of the very state that the API says.
    numbers = page.inner_text("#numbers")
    for value in session.state()["pose"]["translation_m"]:
        assert f"{abs(value):.3f}" in numbers
    # Contour: blue where the API's contour points are; the frame itself is grey.
    colour = """async () => {
      const contour = await (await fetch('/v1/sessions/seen/contour/%d')).json();
      const canvas = document.getElementById('frame'), pen = canvas.getContext('2d');
      const scale = canvas.width / 320;
      const hits = contour.points_px.map(([u, v]) => {
        const [x, y] = [(u + 0.5) * scale, (v + 0.5) * scale].map(Math.floor);
        const [r, g, b] = pen.getImageData(x, y, 1, 1).data;
        return Math.max(r, g, b) - Math.min(r, g, b) > 60;
      });
      return hits.filter(Boolean).length / hits.length;
    }"""
    width = session.info()["camera"]["width"]

    def blue() -> float:
        until(page, "!document.getElementById('frame-note').textContent.includes('…')")
        frame = int(page.inner_text("#frame-note").split()[-1])
        return page.evaluate(colour.replace("320", str(width)) % frame)

    wait_until(lambda: blue() > 0.95, blue)  # the kept picture may come after the live one
    page.keyboard.press("c")
    wait_until(lambda: blue() < 0.5, blue)


def test_who_pauses_looks_back_while_frames_go_on(service, client, sender, open_page) -> None:
    sender("back").send()
    page = open_page(f"{service.url}#back")
    until(page, "rendezview.updates > 12")
    page.keyboard.press(" ")
    until(page, "document.getElementById('when').textContent.startsWith('paused')")
    note = "Number(document.getElementById('frame-note').textContent.split(' ')[1])"
    before = until(page, note)
    count = client.session("back").info()["frames"]
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    until(page, f"{note} === {before - 2}")
    page.keyboard.press("Home")
    until(page, f"{note} === 0")
    until(page, "document.getElementById('when').textContent === 'paused · now FOUND'")
    wait_until(lambda: client.session("back").info()["frames"] >= count + 5)
    assert page.evaluate(note) == 0
    page.keyboard.press("End")
    until(page, f"{note} > {before}")


def test_the_log_that_is_downloaded_can_be_read(service, sender, open_page) -> None:
    sender("log").send()
    page = open_page(f"{service.url}#log")
    until(page, "rendezview.updates > 5 && !document.getElementById('download').disabled")
    with page.expect_download() as waiting:
        page.keyboard.press("d")
    content = Path(waiting.value.path()).read_bytes()
    states = list(make_reader(io.BytesIO(content)).iter_messages(topics="/rendezview/state"))
    assert len(states) > 5


def test_another_session_can_be_picked(service, sender, open_page) -> None:
    sender("one").send()
    sender("two").send()
    page = open_page(f"{service.url}#one")
    word_is(page, "FOUND")
    until(page, "document.getElementById('sessions').options.length >= 2")
    page.keyboard.press("s")
    page.select_option("#sessions", "two")
    until(
        page, "location.hash === '#two' && document.getElementById('word').textContent === 'FOUND'"
    )


def test_a_token_is_asked_for_and_used(start_service, camera, open_page, shoot, tmp_path) -> None:
    secret = "correct-horse-battery"
    tokens = tmp_path / "tokens.toml"
    tokens.write_text(f'[page]\nscope = "track"\ntoken = "{secret}"\n')
    served = start_service("--tokens", str(tokens))
    with served.client(secret) as client:
        client.open(camera, name="closed")
        page = open_page(served.url)
        until(page, "document.getElementById('token-dialog').open")
        page.keyboard.type("wrong")
        page.keyboard.press("Enter")
        until(page, "document.getElementById('token-why').textContent.includes('not right')")
        page.fill("#token-value", "one with spaces")
        page.keyboard.press("Enter")
        until(page, "document.getElementById('token-why').textContent.includes('no spaces')")
        page.keyboard.press("Escape")
        word_is(page, "NO ACCESS")
        shoot(page, "no-access")
        page.click("#token")
        page.fill("#token-value", secret)
        page.keyboard.press("Enter")
        until(page, "document.getElementById('link').textContent.includes('● connected')")
        assert page.input_value("#sessions") == "closed"
        client.session("closed").close()
    word_is(page, "ENDED")


def test_the_fused_pose_and_what_other_sensors_saw_are_shown(
    service, client, camera, open_page, tour
) -> None:
    session = client.open(camera, name="fused", prior=tour[0][1])
    image = tour[0][2]
    session.track(image, 0.0)
    page = open_page(f"{service.url}#fused", tolerates="net::ERR_FAILED")
    until(page, "rendezview.updates > 0")
    assert page.is_hidden("#fused")
    record = {
        "pose": tour[0][1].as_dict(),
        "covariance": (1e-4 * np.eye(6)).tolist(),
        "spots": [{"x_px": 40.0, "y_px": 330.0}],
    }
    # On the circle about the spot.
    pink = """(() => {
      const canvas = document.getElementById('frame'), scale = canvas.width / 400;
      const at = [(34.0 + 0.5) * scale, (330.0 + 0.5) * scale].map(Math.floor);
      const pen = canvas.getContext('2d');
      const data = pen.getImageData(at[0] - 1, at[1] - 1, 3, 3).data;
      return [...Array(9).keys()].some((k) => data[4 * k] > data[4 * k + 1] + 60);
    })()"""
    times_s = itertools.count(1.0, 0.1)

    def kept() -> bool:
        """The page has the last frame, and the picture that is kept of it has marks.

        Four pictures a second are kept; one that is older than the marks has none.
        """
        time_s = next(times_s)
        session.measure("mirrors", record | {"time_s": time_s})
        frame = session.track(image, time_s + 0.05)["frame"]
        until(page, f"rendezview.frame === {frame}")
        marks = client.request("GET", f"/v1/sessions/fused/marks/{frame}")
        return bool(marks) and page.evaluate(pink)

    wait_until(kept)
    state = session.state()
    assert state["fused"]["pose"] is not None
    until(page, "!document.getElementById('fused').hidden")
    text_has(page, "#fused", "m/s")
    text_has(page, "#sensors", "mirrors")
    text_has(page, "#sensors", "received · accepted · NIS")
    picture = os.environ.get("RENDEZVIEW_TEST_PICTURES")
    if picture:
        page.screenshot(path=f"{picture}/fused.png")
    # Looking back too: those that belong to the picture.
    page.keyboard.press(" ")
    until(page, "!document.getElementById('scrub').disabled")
    until(page, "document.getElementById('frame-note').textContent.includes('frame')")
    until(page, pink)
    if picture:
        page.screenshot(path=f"{picture}/fused_back.png")
    page.keyboard.press("End")
    # Marks that cannot be had are missed, and a frame that has none is not.
    page.route("**/marks/*", lambda route: route.abort())
    page.keyboard.press(" ")
    text_has(page, "#frame-note", "no marks: the service cannot be reached")
    page.unroute("**/marks/*")
    page.keyboard.press("End")
    page.keyboard.press("p")
    until(page, "!document.getElementById('layer-spots').checked")
    # Ellipses: drawn where the ring's record has them; on the long axis.
    told = [{"centre_px": [60.0, 60.0], "semi_axes_px": [30.0, 15.0], "angle_rad": 0.5}]
    tip = [60.0 + 30.0 * np.cos(0.5), 60.0 + 30.0 * np.sin(0.5)]
    script = """async ([told, tip]) => {
      const { LiveView } = await import('/live.js');
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [400, 400];
      const view = new LiveView(canvas);
      view.layers.nodes = false;
      view.draw({ bitmap: null, contour: null, silhouette: null, state: null,
        marks: [{ ellipses: told, chosen: 0, spots_px: [] }] });
      const data = canvas.getContext('2d').getImageData(
        Math.floor(tip[0] + 0.5), Math.floor(tip[1] + 0.5), 1, 1).data;
      return data[0] > data[1] + 60;
    }"""
    assert page.evaluate(script, [told, tip])
    session.close()


def test_a_phone_sees_all_of_it_without_moving_sideways(service, sender, open_page) -> None:
    sender("phone").send()
    page = open_page(f"{service.url}#phone", _PHONE, has_touch=True, is_mobile=True)
    until(page, "rendezview.spaces > 0")
    assert page.evaluate("document.documentElement.scrollWidth") <= _PHONE["width"]
    for part in ("#word", "#frame", "#pause"):  # of the first screen
        box = page.locator(part).bounding_box()
        assert box["x"] >= 0
        assert box["y"] + box["height"] <= _PHONE["height"], part
    page.tap("#pause")
    until(page, "!document.getElementById('scrub').disabled")


def test_every_control_is_reached_by_keys_and_shows_it(service, sender, open_page) -> None:
    sender("keys").send()
    page = open_page(f"{service.url}#keys")
    until(page, "rendezview.updates > 3 && !document.getElementById('download').disabled")
    page.keyboard.press(" ")
    reached = []
    for _ in range(22):
        page.keyboard.press("Tab")
        name, outline = page.evaluate(
            "[document.activeElement.id, getComputedStyle(document.activeElement).outlineStyle]"
        )
        reached.append(name)
        assert name == "" or outline == "solid", name
    layers = {"layer-contour", "layer-nodes", "layer-silhouette"}
    assert {
        "sessions",
        "download",
        "token",
        "help",
        "scene",
        "pause",
        "scrub",
        "span",
        "recordings",
        "models",
        "fit",
        "follow",
    } <= {*reached}
    assert layers <= {*reached}
    # The controls in the view are all within the window of 1280 × 800.
    box = page.locator("#span").bounding_box()
    assert box["y"] + box["height"] <= _DESK["height"]
    assert page.evaluate("document.documentElement.scrollWidth") <= _DESK["width"]


def test_without_webgl_all_else_is_there(service, sender, open_page) -> None:
    sender("plain").send()
    script = """const get = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
        return kind.startsWith('webgl') ? null : get.call(this, kind, ...more);
      }; console.error = () => {};"""
    page = open_page(f"{service.url}#plain", script=script)
    until(page, "document.getElementById('space-note').textContent.includes('no WebGL')")
    until(page, "document.querySelectorAll('#plots canvas').length === 8")
    word_is(page, "FOUND")


def test_the_verdict_on_a_state(service, open_page) -> None:
    """Ambiguous is not lost, and found is green only where nothing contradicts it."""
    page = open_page(f"{service.url}healthz")  # for the page's modules alone
    script = """async (state) => (await import('/status.js')).verdict(state, 0)"""
    state = {"pose": None, "phase": "searching", "status": "ambiguous", "reason": "two fit"}
    assert page.evaluate(script, state | {"candidates": [{}, {}]}) == [
        "ambiguous",
        "AMBIGUOUS",
        "ambiguous: two fit (2 poses fit)",
    ]
    lost = state | {"status": "lost", "candidates": [{}]}
    assert page.evaluate(script, lost)[1] == "LOST"
    state = {"pose": {}, "status": "ok", "reason": None, "confidence": 0.9876}
    fused = {"status": "tracking", "reason": None, "protection": {"alarm": False}}
    assert page.evaluate(script, state) == ["found", "FOUND", "confidence 0.988"]
    assert page.evaluate(script, state | {"fused": fused})[0] == "found"
    starting = fused | {"status": "starting", "reason": "1 of 3 poses agree"}
    key, word, reason = page.evaluate(script, state | {"fused": starting})
    assert (key, word) == ("unsure", "FOUND")
    assert "fused state starting: 1 of 3 poses agree" in reason
    alarm = fused | {"protection": {"alarm": True}}
    key, _, reason = page.evaluate(script, state | {"fused": alarm})
    assert (key, "contradicts" in reason) == ("unsure", True)


def test_the_ellipsoid_is_that_of_drawn_poses(service, open_page) -> None:
    rng = np.random.default_rng(3)
    rotation = Rotation.from_rotvec([0.4, -1.1, 0.7])
    translation = np.array([0.5, -0.3, 20.0])
    half = rng.normal(size=(6, 6)) * np.repeat([2e-3, 2e-2], 3)[:, None]
    covariance = half @ half.T
    deltas = rng.multivariate_normal(np.zeros(6), covariance, 100_000)
    turned = Rotation.from_rotvec(deltas[:, :3]) * rotation
    places = -turned.inv().apply(translation + deltas[:, 3:])
    values, vectors = np.linalg.eigh(np.cov(places.T))
    quat = np.roll(rotation.as_quat(), 1).tolist()
    pose = {"quat_wxyz": quat, "translation_m": translation.tolist()}
    state = {"pose": pose, "covariance": covariance.tolist()}
    page = open_page(f"{service.url}healthz")
    script = """async (state) => {
      const space = await import('/space.js'), pose = await import('/pose.js');
      return {...space.spread(state), at: pose.cameraPosition(state.pose)};
    }"""
    got = page.evaluate(script, state)
    order = np.argsort(got["half"])
    np.testing.assert_allclose(np.array(got["half"])[order], 3 * np.sqrt(values), rtol=0.02)
    alignment = np.abs(np.sum(np.array(got["directions"])[order] * vectors.T, axis=1))
    assert alignment.min() > 0.99
    np.testing.assert_allclose(got["at"], -rotation.inv().apply(translation), atol=1e-12)
