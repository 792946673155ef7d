"""WebSockets: the newest frame wins, and watchers see what they ask for."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from tests.waiting import MOST_S, wait_until
from websockets.sync.client import connect

from rendezview.errors import RendezviewError
from rendezview_service.client import Client, ServiceError, pose_of_state
from rendezview_service.hub.history import Histories
from rendezview_service.hub.inputs import SessionInput
from rendezview_service.hub.metrics import Metrics
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.watching import Watcher, Watchers
from rendezview_service.messages.messages import SessionRequest, WatchState
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import camera_message


@pytest.fixture
def session(client, camera, tour):
    opened = client.open(camera, prior=tour[0][1])
    yield opened
    with contextlib.suppress(ServiceError):
        opened.close()


def test_a_stream_gives_a_state_for_each_frame_that_is_waited_for(session, tour):
    with session.stream() as stream:
        for k, (time_s, truth, image) in enumerate(tour[:5]):
            stream.send(image, time_s)
            state = stream.receive(MOST_S)
            assert (state["frame"], state["time_s"], state["drops"]) == (k, time_s, 0)
            assert pose_of_state(state).angle_to(truth) < np.deg2rad(2.0)


def test_the_newest_frame_wins_and_drops_are_counted(session, tour):
    image = tour[0][2]
    sent = 0
    with session.stream() as stream:
        while session.info()["sensors"][0]["drops"] == 0:  # until they come too fast
            for _ in range(20):
                stream.send(image, float(sent))
                sent += 1
        seen = []
        while not seen or seen[-1]["time_s"] < sent - 1:
            seen.append(stream.receive(MOST_S))
    assert len(seen) < sent
    assert seen[-1]["drops"] == sent - len(seen)
    assert session.info()["sensors"][0]["drops"] == sent - len(seen)
    times = [state["time_s"] for state in seen]
    assert times == sorted(times)


def test_what_is_no_frame_is_answered_and_the_stream_goes_on(service, session, tour):
    url = session.client.stream_url(session.name, "stream")
    image = tour[0][2]
    with connect(url, compression=None, max_size=None) as socket:
        for message in (b"", b"\x00" * 8, b"\x00" * 20, "text", struct.pack("<d", np.inf) + b"x"):
            socket.send(message)
            told = json.loads(socket.recv(MOST_S))
            assert told["status"] == 422, told
            assert told["error"]
        socket.send(struct.pack("<d", 1.0) + image.tobytes())
        assert json.loads(socket.recv(MOST_S))["status"] == "ok"


def test_a_watcher_sees_states_contours_and_pictures(session, tour):
    url = session.client.stream_url(session.name, "watch?rate_hz=100&width=200&silhouette=1")
    with connect(url, max_size=None) as socket:
        wait_until(lambda: session.info()["watchers"] == 1)
        for time_s, _, image in tour[:3]:
            state = session.track(image, time_s)
            told = json.loads(socket.recv(MOST_S))
            WatchState.model_validate(told)
            assert told["state"] == state
            assert len(told["contour"]["points_px"]) > 30
            assert told["silhouette_px"][0]
            assert told["image_follows"]
            picture = socket.recv(MOST_S)
            assert int.from_bytes(picture[:8], "little") == state["frame"]
            grey = cv2.imdecode(np.frombuffer(picture[8:], np.uint8), cv2.IMREAD_GRAYSCALE)
            # The history's pictures are larger; a watcher never gets less than it asked for.
            assert grey.shape[1] in (200, 400)
            time.sleep(0.02)
        session.close()
        assert json.loads(socket.recv(MOST_S))["type"] == "end"
    wait_until(lambda: session.client.sessions() == [])


def test_a_watcher_is_due_as_often_as_it_asked_for():
    """Of 20 frames a second for 5 s, at 4 a second; the clock is the test's."""
    watchers = Watchers(lambda: None)
    watchers.add(Watcher(4.0, 0, contour=False, silhouette=False))
    seen = 0
    for k in range(100):
        now_s = 1000.0 + k / 20.0
        if watchers.extras(now_s, 0) is not None:
            seen += 1
            parts = {"frame": k, "contour": None, "silhouette_px": None}
            watchers.show(now_s, b"{}", parts, b"", b"")
    assert seen == 21


def test_watchers_see_the_last_frame_of_a_burst_and_none_twice(session, tour):
    """Each at its own rate, and what it asked for."""
    urls = [
        session.client.stream_url(session.name, f"watch?width=200&{more}")
        for more in ("rate_hz=10", "rate_hz=2&contour=0&image=0")
    ]
    with connect(urls[0], max_size=None) as fast, connect(urls[1]) as slow:
        wait_until(lambda: session.info()["watchers"] == 2)
        for k in range(4):
            session.track(tour[0][2], float(k))
        seen = [_watched(socket, 3) for socket in (fast, slow)]
    for frames in seen:
        numbers = [told["state"]["frame"] for told, _ in frames]
        assert numbers == sorted(set(numbers))
        assert numbers[-1] == 3
    last, picture = seen[0][-1]
    assert last["contour"]["points_px"]
    assert int.from_bytes(picture[:8], "little") == 3
    last, picture = seen[1][-1]
    assert last["contour"] is None
    assert picture is None


def _watched(socket, last):
    """Messages of a watcher and their pictures up to the last frame, and what comes after it."""

    def message(within_s):
        told = json.loads(socket.recv(within_s))
        return told, socket.recv(MOST_S) if told["image_follows"] else None

    seen = [message(MOST_S)]
    while seen[-1][0]["state"]["frame"] < last:
        seen.append(message(MOST_S))
    with contextlib.suppress(TimeoutError):
        seen.append(message(1.5))  # three periods of the slow one
    return seen


@pytest.mark.parametrize("what", ["stream", "watch"])
def test_a_stream_of_no_session_is_closed_with_the_reason(service, client, what):
    url = client.stream_url("nobody", what)
    with connect(url) as socket, pytest.raises(Exception, match="there is none"):
        socket.recv(MOST_S)


def test_who_comes_while_a_frame_is_looked_at_sees_the_next_one(camera):
    """Its extras were not asked for in the newcomer's name."""
    request = SessionRequest(camera=camera_message(camera))
    shared = Settings(history_image_hz=0.0), Metrics(), Histories(1_000_000)
    session = Session("s", SimpleNamespace(name="m"), request, *shared)
    before, after = (Watcher(30.0, 200, contour=True, silhouette=False) for _ in range(2))
    state = b'{"frame": 0}'
    header = {"frame": 0, "phase": "tracking", "time_s": 0.0, "status": "ok", "track_ms": 1.0,
              "starts": (1, None)}  # fmt: skip
    more = {"frame": 0, "contour": {"points_px": [], "kinds": []}, "silhouette_px": None}
    waiting = SessionInput((b"",), 0.0, 0.0, time.monotonic(), lambda answer: None)
    session.watchers.add(before)
    assert session.header_of(waiting)["extras"]["contour"]
    session.watchers.add(after)
    session.tracked(waiting, header, state)
    session.add_extras(more, b"jpeg")
    assert before.message is not None
    assert after.message is None
    before.due_s = 0.0
    session.header_of(waiting)
    session.add_extras(more, b"jpeg")
    assert json.loads(after.message[0])["contour"] is not None


def test_watchers_that_go_are_forgotten(session):
    url = session.client.stream_url(session.name, "watch")
    for _ in range(3):
        with connect(url):
            wait_until(lambda: session.info()["watchers"] == 1)
        wait_until(lambda: session.info()["watchers"] == 0)


def test_a_stream_waits_as_long_for_its_handshake_as_its_client_waits_for_an_answer():
    """A service that is busy answers late: within the client's limit, not within another one."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with Client(url, timeout_s=0.5) as client:
            start_s = time.monotonic()
            with pytest.raises(RendezviewError, match="does not open"):
                client.session("any").stream()
            assert 0.4 < time.monotonic() - start_s < 8.0  # the library's own limit is 10 s
