"""The page with ring, path and fused state: the numbers of the state, and what is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.service.page_feed import text_has, until
from tests.waiting import wait_until

from rendezview.io.results import read_json_lines
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import ViewModel

pytest.importorskip("playwright", reason="the page's tests want playwright")

_PLAN = {"vbar": {"axis": [-1.0, 0.0, 0.0], "distance_m": 14.0, "speed_m_s": 0.26}}
# Orange pixels of the ring's ellipse about a place, of the picture.
_ORANGE = """([x, y]) => {
  const canvas = document.getElementById('frame'), size = 9;
  const data = canvas.getContext('2d').getImageData(x - size / 2, y - size / 2, size, size).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4) count += data[k] > 220 && data[k + 1] > 120 && data[k + 1] < 200 && data[k + 2] < 110;
  return count;
}"""  # noqa: E501


def test_the_ring_is_drawn_over_the_picture_beside_path_and_fused_state(
    flown, tmp_path, service, client, open_page, shoot
) -> None:
    # The model knows the ring, but has no views of it from near.
    replace(ViewModel.load(flown / "client.rvm"), near=()).save(tmp_path / "client.rvm")
    client.send_model("ringed", tmp_path / "client.rvm")
    frames = open_sequence(flown / "scene").frames
    echoes = read_json_lines(flown / "laser.jsonl")
    with client.open(
        frames[0].camera, name="near", model="ringed", prior=frames[0].camera_from_target,
        sensors={"trajectory": {"shape": "vbar", "plan": _PLAN}},
    ) as session:  # fmt: skip
        page = open_page(f"{service.url}#near")
        text_has(page, "#link", "connected")
        shot = False
        for frame, echo in zip(frames, echoes, strict=True):
            session.measure("laser", echo)
            state = session.track(frame.read(), frame.time_s)
            text_has(page, "#numbers", f"{state['frame']} · t =")
            fitted = bool(state["trajectory"] and state["trajectory"].get("segment"))
            if state["ring"]["ellipse"] and state["pose"] and fitted and not shot:
                shot = True
                until(page, "rendezview.spaces > 0")
                state = _with_word(page, session, frame, state, "FOUND")
                until(page, f"rendezview.frame === {state['frame']}")
                _check(page, state, frame.camera.width)
                shoot(page, "ring")
        assert shot
        # The target overflows the picture: the other sensors carry the state on.
        assert (state["pose"], state["fused"]["status"]) == (None, "tracking")
        state = _with_word(page, session, frame, state, "FUSED")
        text_has(page, "#numbers caption", "Fused pose")
        _check(page, state, frame.camera.width)
        shoot(page, "fused")
        page.uncheck("#layer-ellipses")
        until(page, f"!({_ORANGE})({_on_ellipse(page, state, frame.camera.width)})")
        page.check("#layer-ellipses")
    client.request("DELETE", "/v1/models/ringed")


def _with_word(page, session, frame, state, word) -> dict:
    """The state once the page has a word; it has another one where frames stay away for 3 s."""

    def has_word() -> bool:
        nonlocal state
        state = session.track(frame.read(), state["time_s"] + 0.01)
        return page.inner_text("#word") == word

    wait_until(has_word, lambda: page.inner_text("#word"))
    return state


def _on_ellipse(page, state, width) -> list[float]:
    """An end of the ring's long axis in the canvas."""
    ellipse = state["ring"]["ellipse"]
    ahead = np.array([np.cos(ellipse["angle_rad"]), np.sin(ellipse["angle_rad"])])
    scale = page.evaluate("document.getElementById('frame').width") / width
    end = np.array(ellipse["centre_px"]) + ellipse["semi_axes_px"][0] * ahead
    return ((end + 0.5) * scale).round().tolist()


def _check(page, state, width) -> None:
    text_has(page, "#ring", state["ring"]["status"])
    text_has(page, "#fused", state["fused"]["status"])
    text_has(page, "#path caption", "vbar")
    text_has(page, "#path", f"{np.linalg.norm(state['trajectory']['segment']['velocity_m_s']):.4f}")
    text_has(page, "#path", "Δv")
    until(page, f"({_ORANGE})({_on_ellipse(page, state, width)}) >= 5")
