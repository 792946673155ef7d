"""A closed-loop flight at a real service: it steers by the fused states, its operator commands."""

from __future__ import annotations

import json
import re
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from tests.ground.fly.test_rendered import PLAN
from tests.service.foxglove import FoxgloveViewer
from tests.service.page_feed import text_has, until
from tests.waiting import MOST_S, wait_until
from websockets.sync.client import connect

from rendezview.errors import RendezviewError
from rendezview.io.target import Target
from rendezview_ground.fly.dynamics import OrbitDynamics
from rendezview_ground.fly.guidance import Guidance
from rendezview_ground.fly.live import LiveSensors, ServiceEstimator, fly_live
from rendezview_ground.fly.options import GuidanceOptions
from rendezview_ground.fly.setup import Setup
from rendezview_service.client import ServiceError
from rendezview_service.hub.session_events import AttachedFlight, SessionEvents
from rendezview_service.messages.approach_messages import Flight, Order

REPORT = {
    "time_s": 1.0, "mode": "approach", "reason": "", "range_m": 9.5,
    "switches": {"laser": True, "hand": False},
}  # fmt: skip


@pytest.fixture
def setup(refining_model, bumpy_mesh) -> Setup:
    plan = replace(PLAN, target=replace(PLAN.target, sun_phase_deg=(10.0, 20.0)))
    plan = replace(plan, guidance=GuidanceOptions(longest_s=600.0, holds_m=(7.0,)))
    return Setup.of(Target("bumpy", "", None, "m"), bumpy_mesh, plan)


def _order(client, name, **order) -> None:
    client.request("POST", f"/v1/sessions/{name}/orders", json.dumps(order).encode())


def test_an_order_reaches_the_attached_flight_once_and_is_an_event(client, camera):
    with client.open(camera, name="attached") as session:
        assert session.info()["flight"] is None
        with pytest.raises(ServiceError, match="no flight") as refused:
            _order(client, "attached", do="hold")
        assert refused.value.status == 409

        def report() -> list[dict]:
            body = json.dumps(REPORT).encode()
            return client.request("PUT", "/v1/sessions/attached/flight", body)["orders"]

        assert report() == []
        assert session.info()["flight"] == REPORT
        _order(client, "attached", do="retreat")
        _order(client, "attached", do="switch", what="hand")
        for wrong in ({"do": "switch", "what": "ring"}, {"do": "fire"}):
            with pytest.raises(ServiceError):
                _order(client, "attached", **wrong)
        assert [(order["do"], order["what"], order["on"]) for order in report()] == [
            ("retreat", None, True), ("switch", "hand", True),
        ]  # fmt: skip
        assert report() == []
        events = client.request("GET", "/v1/sessions/attached/events")["events"]
        told = [(e["kind"], e["text"]) for e in events if e["kind"] in ("flight", "operator")]
        assert told == [("flight", "approach"), ("operator", "retreat"), ("operator", "hand on")]


def test_a_flight_that_is_silent_is_attached_no_more(monkeypatch):
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    attached = AttachedFlight(SessionEvents(None, lambda: now_s))
    attached.reported(Flight(**REPORT))
    now_s = 9.0
    assert attached.order(Order(do="hold"))
    now_s = 11.0
    assert attached.report is None
    assert not attached.order(Order(do="hold"))


def test_the_loop_closes_at_a_service_and_its_page_commands_it(
    client, service, setup, open_page, shoot
):
    """From 7 m, until the operator ends the session: held, blinded, and made to turn back."""
    ends: list[BaseException] = []

    def fly() -> None:
        try:
            with service.client() as own:
                fly_live(setup, own, 0, speed=0.0)
        except RendezviewError as error:
            ends.append(error)

    pilot = threading.Thread(target=fly)
    pilot.start()

    def flight() -> dict | None:
        flown = [one for one in client.sessions() if one["flight"] is not None]
        return flown[0] if flown else None

    wait_until(lambda: flight() is not None, lambda: ends)
    name = flight()["id"]
    page = open_page(f"{service.url}#{name}")

    def press(words: str) -> None:
        page.click(f"#flight button:has-text('{words}')")

    wait_until(lambda: flight()["flight"]["mode"] == "approach", flight)
    press("Hold")
    text_has(page, "#flight-mode", "hold ordered")
    text_has(page, "#events", "operator: hold")
    shoot(page, "flight")
    press("hand before")
    wait_until(lambda: client.session(name).state()["pose"] is None)
    until(page, "document.querySelector('#flight [aria-pressed=true]:last-child') !== null")
    press("hand before")
    wait_until(lambda: client.session(name).state()["pose"] is not None)
    press("camera")
    wait_until(lambda: not flight()["flight"]["switches"]["camera"])
    frames = flight()["frames"]
    at_s = flight()["flight"]["time_s"]
    wait_until(lambda: flight()["flight"]["time_s"] > at_s + 6.0)
    assert flight()["frames"] <= frames + 1
    press("Retreat")
    text_has(page, "#events", "operator: retreat")
    client.session(name).close()
    until(page, "document.getElementById('flight').hidden")
    pilot.join(MOST_S)
    # A reading that is under way is told the reason, the next one that there is no such session.
    assert any(words in str(ends[0]) for words in ("closed by a request", "has ended"))
    page.close()


def test_the_state_of_the_service_is_near_the_truth_and_a_refused_reading_is_lost(client, setup):
    sensors, dynamics = LiveSensors(setup, 0), OrbitDynamics(setup.plan, setup.port, 0)
    guidance, truth, known = Guidance(setup.plan, setup.port), dynamics.start(), None
    with ServiceEstimator(client, sensors, guidance, speed=0.0) as estimator:
        for _ in range(15):
            known = estimator.update(truth.time_s, sensors.read(truth, known))
            truth = dynamics.step(truth, guidance.command(known))
        estimate = known.estimate
        assert estimate.status == "tracking"
        assert estimate.pose.angle_to(truth.pose) < np.deg2rad(3.0)
        assert np.linalg.norm(estimate.pose.translation_m - truth.pose.translation_m) < 0.3
        assert estimate.covariance.shape == (12, 12)
        assert 0.0 < estimate.protection.position_m < 1.0
        assert estimator.update(truth.time_s, []).estimate.pose is None  # nothing came back


def test_foxglove_and_ros_see_the_fused_states_and_the_orders_of_a_flight(watched, setup):
    sensors, dynamics = LiveSensors(setup, 0), OrbitDynamics(setup.plan, setup.port, 0)
    guidance, fused = Guidance(setup.plan, setup.port), {}
    at = f"ws://127.0.0.1:{watched.foxglove}"
    with (
        watched.served.client() as client,
        connect(at, subprotocols=["foxglove.sdk.v1"]) as stream,
        ServiceEstimator(client, sensors, guidance, speed=0.0) as estimator,
    ):
        truth, known, viewer = dynamics.start(), None, FoxgloveViewer(stream)
        for k in range(60):
            known = estimator.update(truth.time_s, sensors.read(truth, known))
            name = estimator.session.name
            if known.estimate.pose is not None:
                fused[round(1e3 * truth.time_s)] = known.estimate.pose.translation_m
            truth = dynamics.step(truth, guidance.command(known))
            if k == 30:
                _order(client, name, do="hold")
            viewer.listen(0.05)
            if "hold ordered" in str(viewer.seen.get(f"/{name}/flight")):
                break
    assert {f"/{name}/state", f"/{name}/target/fused", f"/{name}/flight"} <= set(viewer.seen)

    def received(topic: str) -> list[dict]:
        key = re.sub(r"^(?=\d)|\W", "_", name) + f"/{topic}"
        return [line for line in watched.received if line["topic"] == key]

    def reasons() -> list[str]:
        return [json.loads(line["text"])["reason"] for line in received("flight")]

    wait_until(lambda: reasons()[-1:] == ["hold ordered"], reasons)
    assert all(line["known"] for line in received("flight") + received("target/fused"))
    both = [(line["xyz"], fused.get(round(1e3 * line["sec"] + 1e-6 * line["nanosec"])))
            for line in received("target/fused")]  # fmt: skip
    steered = [(seen_m, used_m) for seen_m, used_m in both if used_m is not None]
    assert len(steered) > 3
    for seen_m, used_m in steered:
        assert seen_m == pytest.approx(used_m, abs=1e-6)


def test_serve_flies_by_itself_and_its_flight_ends_with_it(start_service):
    served = start_service("--fly", "client")
    with served.client() as client:
        wait_until(lambda: any(s["flight"] for s in client.sessions()), lambda: served.lines)
    children = [child.pid for child in psutil.Process(served.process.pid).children()]
    (pilot,) = [pid for pid in children if b"--live" in _command(pid)]
    served.stop()
    assert b"--live" not in _command(pilot)


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
