"""Events, recordings, the numbers of the filter in states, and a client that connects again."""

from __future__ import annotations

import io

import httpx
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from tests.waiting import MOST_S

from rendezview.errors import RendezviewError
from rendezview_service.client import ServiceError
from rendezview_service.hub.history import Histories, Past
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.messages import EventList, History, State
from rendezview_service.messages.model_messages import Geometry, RecordedList

PORT = {"centre_m": [-1.0, 0.0, 0.0], "axis": [-1.0, 0.0, 0.0]}


@pytest.fixture(scope="module")
def taped(service, camera, tour):
    """States of a recorded session that has ended, with an approach and a dark end."""
    asked = {"port": PORT, "limits": [{"quantity": "range_m", "least": 9.5}]}
    with (
        service.client() as client,
        client.open(camera, name="looked-back", prior=tour[0][1], approach=asked) as session,
    ):
        states = [session.track(image, 5.0 * k) for k, (_, _, image) in enumerate(tour[:12])]
        dark = np.zeros_like(tour[0][2])
        states.append(session.track(dark, 5.0 * 12))
        events = client.request("GET", "/v1/sessions/looked-back/events")
        later = client.request("GET", "/v1/sessions/looked-back/events?since=2")
    return states, events, later


def test_states_have_the_motion_of_a_filter(taped, tour) -> None:
    states = taped[0]
    for state in states:
        State.model_validate(state)
    # The tour turns by (1.0, -0.8, 0.5) degrees from frame to frame; 5 s lie between them.
    rate = np.rad2deg(states[11]["motion"]["rates"]["angular_rad_s"])
    np.testing.assert_allclose(rate, np.array([1.0, -0.8, 0.5]) / 5.0, atol=0.02)
    assert states[11]["motion"]["status"] == "tracking"
    sigma = np.rad2deg(states[11]["motion"]["angular_sigma_rad_s"])
    assert np.all(sigma < 0.05)
    assert states[11]["approach"]["along_m"] is not None
    # Without a pose of the frame it is the prediction, and less sure.
    last = states[12]
    assert last["pose"] is None
    wider = np.diag(last["motion"]["covariance"]) > np.diag(states[11]["motion"]["covariance"])
    assert wider.all()


def test_events_tell_of_phases_alarms_and_the_recording(taped) -> None:
    _, events, later = taped
    told = EventList.model_validate(events).events
    assert [event.number for event in told] == list(range(len(told)))
    kinds = [event.kind for event in told]
    assert kinds[:2] == ["recording", "phase"]
    assert "tracking" in told[1].text
    assert any(e.kind == "alarm" and "less than 9.5 m" in e.text for e in told)
    assert EventList.model_validate(later).events[0].number == 2
    times = [event.unix_s for event in told]
    assert times == sorted(times)


def test_recordings_are_listed_and_looked_through(taped, service, client) -> None:
    states = taped[0]
    other = service.folder / "another-program.mcap"
    with open(other, "wb") as file:
        writer = Writer(file)
        writer.start(library="another")
        writer.finish()
    recordings = RecordedList.model_validate(client.request("GET", "/v1/recordings")).recordings
    names = [one.name for one in recordings]
    assert other.name not in names
    # A busy machine may answer the first request late; the client then opens once more.
    one = max((r for r in recordings if r.session == "looked-back"), key=lambda r: r.frames)
    assert one.frames == len(states)
    assert one.model_sha256 == states[0]["model_sha256"]
    at = f"/v1/recordings/{one.name}"
    history = History.model_validate(client.request("GET", f"{at}/history"))
    assert [s.frame for s in history.states] == [s["frame"] for s in states]
    assert history.states[3].pose.translation_m == states[3]["pose"]["translation_m"]
    # Phases and the first alarm, as the session had them while it was open.
    then = EventList.model_validate(taped[1]).events
    for kind, count in (("phase", None), ("alarm", 1)):
        both = [[(e.level, e.text) for e in of if e.kind == kind] for of in (then, history.events)]
        assert both[0][:count] == both[1][:count] != []
    assert history.events[0].unix_s == states[0]["received_unix_s"]
    assert 0.0 < states[0]["received_unix_s"] - one.opened_unix_s < MOST_S
    thin = client.request("GET", f"{at}/history?limit=5")
    assert len(thin["states"]) <= 5
    answer = httpx.get(f"{service.url}{at[1:]}/images/4", timeout=MOST_S)
    assert answer.headers["X-Frame"] == "4"
    assert answer.headers["Content-Type"] == "image/jpeg"
    contour = client.request("GET", f"{at}/contour/4")
    assert len(contour["points_px"]) > 50
    assert not contour["predicted"]
    Geometry.model_validate(client.request("GET", f"{at}/geometry"))
    assert client.request("GET", f"{at}/approach")["port"]["centre_m"] == PORT["centre_m"]
    log = client.fetch("GET", f"{at}/log")
    topic = "/rendezview/state"
    assert len(list(make_reader(io.BytesIO(log)).iter_messages(topics=topic))) == len(states)
    for wrong in ("none.mcap", "..%2Fx.mcap", other.name + "x"):
        with pytest.raises(ServiceError) as refused:
            client.request("GET", f"/v1/recordings/{wrong}/history")
        assert refused.value.status == 404
    with pytest.raises(ServiceError) as refused:
        client.request("GET", f"/v1/recordings/{other.name}/approach")
    assert refused.value.status == 422


def test_a_log_with_motion_and_approach_is_repeated_bit_for_bit(taped, service) -> None:
    path = max(service.folder.glob("looked-back-*.mcap"), key=lambda log: log.stat().st_size)
    log = read_log(path)
    compared = [so_far for _, so_far in repeat(log, model_of(log, None))]
    assert (compared[-1].frames, compared[-1].first_difference) == (13, None)


def test_errors_of_the_client_are_its_own() -> None:
    from rendezview_service.client import Client

    for url in ("http://[", "http://127.0.0.1:99999", "ftp://127.0.0.1", "127.0.0.1:8360"):
        with pytest.raises(RendezviewError, match="http://host:port"):
            Client(url)
    with pytest.raises(RendezviewError, match="no spaces"):
        Client("http://127.0.0.1:9", token="two words")
    with Client("http://127.0.0.1:9") as client, pytest.raises(RendezviewError, match="running"):
        client.sessions()


def test_the_newest_state_is_kept_however_fast_they_come() -> None:
    past = Past(keep_s=300.0, rate_hz=30.0, image_hz=4.0, histories=Histories(10_000_000))
    for frame in range(4):
        past.add(0.01 * frame, frame, b"%d" % frame)
    assert past.states(-1.0, 0, 10) == [(0, b"0"), (3, b"3")]
    assert [past.state(frame) for frame in range(4)] == [b"0", b"0", b"0", b"3"]
    past.add(0.04, 4, b"4")
    assert past.states(-1.0, 0, 10) == [(0, b"0"), (4, b"4")]


def test_with_too_many_bytes_the_session_with_the_most_forgets_its_oldest() -> None:
    histories = Histories(1000)
    small, large = (Past(300.0, 30.0, 4.0, histories) for _ in range(2))
    for past in (small, large):
        histories.enter(past)
    small.add(0.0, 0, bytes(100))
    for frame in range(40):
        large.add(float(frame), frame, bytes(20))
        large.add_image(float(frame), frame, bytes(80))
    assert small.state(0) == bytes(100)
    assert large.image_frames == list(range(32, 40))
    assert histories.held == small.held + large.held <= 1000
    histories.leave(large)
    assert histories.held == 100
