"""Sessions over HTTP: frames in, poses out, and what is refused."""

from __future__ import annotations

import json
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor

import cv2
import httpx
import numpy as np
import pytest
from tests.waiting import MOST_S

from rendezview.sensors.appearance import Recognizer, Tracker
from rendezview_service.client import ServiceError, pose_of_state
from rendezview_service.messages.messages import History, SessionInfo, State
from rendezview_service.messages.model_messages import Geometry


@pytest.fixture
def session(client, camera, tour):
    opened = client.open(camera, prior=tour[0][1])
    yield opened
    opened.close()


def test_a_frame_gives_the_pose_that_the_tracker_gives(session, refining_model, camera, tour):
    tracker = Tracker(Recognizer(refining_model, camera), tour[0][1])
    for time_s, truth, image in tour[:6]:
        state = session.track(image, time_s)
        State.model_validate(state)
        assert state["status"] == "ok", state["reason"]
        pose = pose_of_state(state)
        alone = tracker.update(time_s, image)
        assert pose.angle_to(alone.pose) < 1e-7
        assert pose.translation_m == pytest.approx(alone.pose.translation_m, abs=1e-9)
        assert pose.angle_to(truth) < np.deg2rad(2.0)
        assert np.array(state["covariance"]) == pytest.approx(alone.covariance, rel=1e-6)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_packed_frames_are_frames(session, tour, suffix):
    time_s, truth, image = tour[0]
    content = cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
    state = session.track(content, time_s)
    assert pose_of_state(state).angle_to(truth) < np.deg2rad(2.0)


def test_a_frame_of_nothing_has_a_status_and_a_reason_and_no_pose(session, camera):
    state = session.track(np.zeros((camera.height, camera.width), np.uint8), 1.0)
    assert state["status"] != "ok"
    assert state["reason"]
    assert state["pose"] is None
    assert state["covariance"] is None
    with pytest.raises(ServiceError) as refused:
        session.client.request("GET", f"/v1/sessions/{session.name}/state?as=transform_stamped")
    assert refused.value.status == 404


def test_time_must_rise(session, tour):
    session.track(tour[1][2], 5.0)
    for time_s in (5.0, 4.9):
        with pytest.raises(ServiceError, match="order of time") as refused:
            session.track(tour[1][2], time_s)
        assert refused.value.status == 422
    assert session.track(tour[1][2], 5.1)["frame"] == 1


@pytest.mark.parametrize("time_s", ["nan", "inf", "-inf", "1e300", "soon", ""])
def test_a_time_that_is_none_is_refused(session, tour, time_s):
    path = f"/v1/sessions/{session.name}/frames?time_s={time_s}"
    with pytest.raises(ServiceError, match="time_s") as refused:
        session.client.request("POST", path, tour[0][2].tobytes(), "application/octet-stream")
    assert refused.value.status == 422


def test_frames_that_are_none_are_refused_and_the_session_goes_on(session, tour, camera):
    time_s, _, image = tour[0]
    png = cv2.imencode(".png", image)[1].tobytes()
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    bomb = bytearray(png)
    bomb[16:24] = (60000).to_bytes(4, "big") * 2
    small = cv2.imencode(".png", image[:100])[1].tobytes()
    for content, said in [
        (b"\x00" * 10, "a raw frame"),
        (png[:-20], "cut short"),
        (jpeg[:-20], "cut short"),
        (bytes(bomb), "cut short or damaged"),
        (_resized(png, 60000), "60000 × 60000"),
        (small, "400 × 100"),
        (png[:60] + b"\xff" * 30 + png[90:], "damaged"),
    ]:
        with pytest.raises(ServiceError, match=said) as refused:
            session.client.request("POST", f"{session._path}/frames", content, "image/png")
        assert refused.value.status == 422
    assert session.track(image, time_s)["frame"] == 0


def _resized(png: bytes, size: int) -> bytes:
    """A PNG whose header says another size, with its right checksum."""
    head = b"IHDR" + size.to_bytes(4, "big") * 2 + png[24:29]
    return png[:12] + head + zlib.crc32(head).to_bytes(4, "big") + png[33:]


def test_a_body_that_is_too_long_is_refused(session):
    with pytest.raises(ServiceError, match="too long") as refused:
        session.client.request("POST", f"{session._path}/frames", bytes(32_000_001), "image/png")
    assert refused.value.status == 413


def _turned(w: float) -> dict:
    return {"quat_wxyz": [w, 0, 0, 0], "translation_m": [0, 0, 5]}


IMPOSSIBLE_FUSION = [
    ({"ring": {"centre_m": [0, 0, 0], "axis": [0, 0, 0], "radius_m": 1}}, "direction"),
    ({"ring": {"centre_m": [0, 0, 0], "axis": [0, 0, 1], "radius_m": -1}}, "radius_m"),
    ({"mounts": {"a": _turned(0.0)}}, "quat"),
    ({"mounts": {"a": _turned(1e-320)}}, "direction"),
    ({"mounts": {"a": _turned(1e308)}}, "direction"),
    ({"options": {"speed": 1}}, "speed"),
    ({"options": {"history_s": 1e6}}, "history_s"),
    ({"options": {"motion": {"angular": -1.0}}}, "angular"),
    ({"surfaces": [{"point_m": [0, 0], "normal": [0, 0, 1]}]}, "point_m"),
]


def test_impossible_sessions_are_refused(client, camera):
    good = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    for request, said in [
        ({"camera": good, "model": "nobody"}, "not here"),
        ({"camera": good | {"fx": 0.0}}, "fx"),
        ({"camera": good | {"distortion": [0.1, 0.2]}}, "distortion"),
        ({"camera": good | {"width": 16384, "height": 16384}}, "larger"),
        ({"camera": good, "id": "../../etc"}, "id"),
        ({"camera": good, "sun_camera": [0, 0, 0]}, "sun_camera: .*direction"),
        ({"camera": good, "sun_camera": [1e308] * 3}, "direction"),
        ({"camera": good, "sun_camera": [1e-320, 0.0, 0.0]}, "direction"),
        ({"camera": good, "speed": 3}, "speed"),
        ({"camera": good, "prior": _turned(0.0)}, "quat_wxyz"),
        ({"camera": good, "approach": {"port": {"centre_m": [0] * 3, "axis": [1e308, 0, 1e308]}}},
         "direction"),
        *[({"camera": good, "fusion": fusion}, said) for fusion, said in IMPOSSIBLE_FUSION],
        ({}, "camera"),
    ]:  # fmt: skip
        with pytest.raises(ServiceError, match=said) as refused:
            client.request("POST", "/v1/sessions", json.dumps(request).encode())
        assert refused.value.status == 422
    assert client.sessions() == []


def test_there_is_room_for_so_many_sessions_and_no_more(client, camera):
    opened = [client.open(camera) for _ in range(6)]
    with pytest.raises(ServiceError) as refused:
        client.open(camera)
    assert refused.value.status == 429
    opened.pop().close()
    with pytest.raises(ServiceError, match="there is one already"):
        client.open(camera, name=opened[0].name)
    for session in opened:
        session.close()
    with pytest.raises(ServiceError) as refused:
        opened[0].state()
    assert refused.value.status == 404


def test_more_frames_than_may_wait_are_told_to_come_back(service, session, tour):
    statuses = []

    def send(k: int) -> None:
        path = f"{service.url}v1/sessions/{session.name}/frames?time_s={k}"
        statuses.append(httpx.post(path, content=tour[0][2].tobytes(), timeout=MOST_S))

    threads = [threading.Thread(target=send, args=(k,)) for k in range(24)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(MOST_S)
    busy = [answer for answer in statuses if answer.status_code == 429]
    assert len(statuses) == 24
    assert all(answer.headers["retry-after"] for answer in busy)
    assert {answer.status_code for answer in statuses} <= {200, 422, 429}


def test_the_state_comes_in_the_types_of_ros(session, tour):
    state = session.track(tour[0][2], 12.25)
    path = f"/v1/sessions/{session.name}/state?as="
    stamped = session.client.request("GET", path + "pose_with_covariance_stamped")
    x, y, z = state["pose"]["translation_m"]
    assert stamped["header"] == {"stamp": {"sec": 12, "nanosec": 250_000_000}, "frame_id": "camera"}
    assert stamped["pose"]["pose"]["position"] == {"x": x, "y": y, "z": z}
    ours = np.array(state["covariance"])
    theirs = np.array(stamped["pose"]["covariance"]).reshape(6, 6)
    assert theirs[:3, :3] == pytest.approx(ours[3:, 3:])  # translation first
    assert theirs[3:, :3] == pytest.approx(ours[:3, 3:])
    transform = session.client.request("GET", path + "transform_stamped")
    w, qx, qy, qz = state["pose"]["quat_wxyz"]
    assert transform["transform"]["rotation"] == {"x": qx, "y": qy, "z": qz, "w": w}
    assert transform["child_frame_id"] == "target"


def test_history_gives_states_pictures_and_contours_of_what_was(session, tour, client):
    for time_s, _, image in tour:
        last = session.track(image, time_s)
    path = f"/v1/sessions/{session.name}"
    history = client.request("GET", f"{path}/history?limit=5")
    History.model_validate(history)
    assert len(history["states"]) <= 5
    assert history["newest_frame"] == history["states"][-1]["frame"] <= last["frame"]
    assert history["images"][0] == 0
    picture = cv2.imdecode(
        np.frombuffer(client.fetch("GET", f"{path}/images/0"), np.uint8), cv2.IMREAD_GRAYSCALE
    )
    assert picture.shape == (400, 400)
    assert np.abs(picture.astype(float) - tour[0][2]).mean() < 5.0
    contour = client.request("GET", f"{path}/contour/0")
    lit = tour[0][2] > 60
    inside = cv2.dilate(lit.astype(np.uint8), np.ones((5, 5))) > 0
    at = np.clip(np.rint(contour["points_px"]).astype(int), 0, 399)
    assert len(at) > 30
    assert np.mean(inside[at[:, 1], at[:, 0]]) > 0.95


def test_a_session_says_how_it_stands(service, session, tour):
    assert session.info()["phase"] == "waiting"
    for time_s, _, image in tour[:3]:
        session.track(image, time_s)
    info = SessionInfo.model_validate(session.info())
    assert info.phase == "tracking"
    assert (info.frames, info.last_frame, info.found_fraction) == (3, 2, 1.0)
    assert info.sensors[0].healthy
    assert info.recording.state == "on"
    assert (service.folder / info.recording.name).stat().st_size == info.recording.size_bytes
    black = np.zeros_like(tour[0][2])
    assert session.track(black, 1.0)["phase"] == "coasting"
    assert session.track(black, 30.0)["phase"] == "searching"


def test_the_geometry_is_of_the_target(client, refining_model, bumpy_mesh):
    geometry = Geometry.model_validate(client.request("GET", "/v1/models/bumpy/geometry"))
    points = np.array(geometry.points_m)
    low, high = bumpy_mesh.vertices_m.min(axis=0), bumpy_mesh.vertices_m.max(axis=0)
    assert len(points) > 200
    assert (points > low - 0.1).all()
    assert (points < high + 0.1).all()
    assert len(geometry.nodes) == len(refining_model.geodesic.nodes)
    assert len(geometry.tangents) == len(points) == len(geometry.kinds)


def test_threads_that_share_a_client_get_their_own_answers(client, camera):
    """Two on one connection would read each other's answers, and lose its socket."""
    with client.open(camera, name="one"), client.open(camera, name="other"):
        names = ["one", "other"] * 40

        def seen(name: str) -> str:
            return client.request("GET", f"/v1/sessions/{name}")["id"]

        with ThreadPoolExecutor(8) as threads:
            assert list(threads.map(seen, names)) == names
