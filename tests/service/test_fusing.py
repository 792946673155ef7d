"""Several sensors of one session: lines in, one state out, logged and repeated."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from tests.service.sensors import RING, Sensors
from tests.waiting import MOST_S, wait_until
from websockets.sync.client import connect

from rendezview.errors import RendezviewError
from rendezview.fusion import BeamSurface, Fusion, PoseMeasurement
from rendezview.fusion.logs import LogContext, kind_of, read_record
from rendezview_service.client import ServiceError, fused_pose_of_state, pose_of_state
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.fusion_messages import LoggedMeasurement, Marks, Measured
from rendezview_service.messages.messages import State, WatchState

POSTED = {"ring": False}  # the ring's readings come as lines


# What the drawn ranger's beam meets.
PLANE = BeamSurface(RING.centre_m, RING.axis, 0.5)
FUSION = {
    "ring": RING,
    "surfaces": [{"point_m": RING.centre_m, "normal": RING.axis, "relief_m": PLANE.relief_m}],
}


@pytest.fixture
def sensors() -> Sensors:
    return Sensors()


@pytest.fixture
def session(client, camera, tour):
    opened = client.open(camera, prior=tour[0][1], fusion=FUSION, sensors=POSTED)
    yield opened
    with contextlib.suppress(ServiceError):
        opened.close()


def test_lines_read_for_the_service_are_those_of_the_command(sensors, tour):
    time_s, truth, _ = tour[0]
    context = LogContext(RING)
    for record in (sensors.ring(time_s, truth), sensors.range(time_s, truth)):
        kind = kind_of(record, "here")
        assert read_record(record, kind, "any", context, "here").time_s == time_s
        with pytest.raises(RendezviewError, match=r"where it is|the surfaces it can hit"):
            read_record(record, kind, "any", LogContext(), "here")


def test_a_state_is_what_the_filter_gives_of_the_same_words(session, sensors, tour):
    own = Fusion(None)
    context = LogContext(RING, (PLANE,))
    for k, (time_s, truth, image) in enumerate(tour[:8]):
        state = session.track(image, time_s)
        State.model_validate(state)
        assert ("fused" in state) == (k > 0)
        pose, covariance = pose_of_state(state), np.array(state["covariance"])
        own.add(PoseMeasurement(time_s, "camera", pose, covariance))
        if k > 0:  # the first pose waits for another sensor
            assert state["fused"]["status"] == str(own.state_at(time_s).status)
        lines = [sensors.pose(time_s, truth), sensors.ring(time_s + 0.01, truth),
                 sensors.range(time_s + 0.02, truth)]  # fmt: skip
        for sensor, record in zip(("mirrors", "ring", "laser"), lines, strict=True):
            told = Measured.model_validate(session.measure(sensor, record))
            measurement = read_record(record, kind_of(record, ""), sensor, context, "")
            verdict = own.add(measurement)
            assert told.verdicts[0].accepted == verdict.accepted
            assert told.recorded
        expected = own.state_at(record["time_s"])
        assert np.array(told.fused.covariance) == pytest.approx(expected.covariance, rel=1e-6)
    assert expected.status == "tracking"
    fused = fused_pose_of_state(told.model_dump())
    assert fused.translation_m == pytest.approx(expected.pose.translation_m, abs=1e-9)
    assert fused.angle_to(truth) < np.deg2rad(2.0)
    health = {s["name"]: s for s in session.info()["sensors"]}
    assert [(name, s["kind"]) for name, s in health.items()] == [
        ("camera", "camera"), ("mirrors", "pose"), ("ring", "ring"), ("laser", "range"),
    ]  # fmt: skip
    assert health["camera"]["trust"]["heard"] == 8
    assert health["ring"]["frames"] == health["ring"]["trust"]["heard"] == 8
    assert health["ring"]["healthy"]
    metrics = session.client.fetch("GET", "/metrics").decode()
    assert f'sensor="laser",session="{session.name}"}} 8.0' in metrics


def test_a_camera_alone_has_states_as_ever(session, sensors, tour):
    silent = {"time_s": 0.0, "status": "lost", "pose": None, "covariance": None}
    told = session.measure("mirrors", silent)
    assert (told["verdicts"], told["fused"]) == ([None], None)
    assert "fused" not in session.track(tour[0][2], 0.0)
    assert session.info()["sensors"][0]["trust"] is None


def test_a_sensor_that_lies_is_locked_out_and_said_so(session, sensors, tour):
    for k, (time_s, truth, image) in enumerate(tour[:12]):
        time_s *= 20.0  # the tour turns faster than the filter expects
        session.track(image, time_s)
        session.measure("mirrors", sensors.pose(time_s, truth))
        if k > 3:  # before, nobody can know who lies
            told = session.measure("liar", sensors.pose(time_s, truth, offset_m=3.0))
    assert not told["verdicts"][0]["accepted"]
    assert told["verdicts"][0]["nis"] > 100.0
    liar = next(s for s in session.info()["sensors"] if s["name"] == "liar")
    assert liar["trust"]["locked_out"]
    assert "locked out" in liar["reason"]
    assert fused_pose_of_state(told).translation_m == pytest.approx(truth.translation_m, abs=0.3)


def _bad(sensors, truth):
    pose, ring = sensors.pose(1.0, truth), sensors.ring(1.0, truth)
    reach = sensors.range(1.0, truth)
    negative = np.diag([1e-4] * 4 + [-1e-4]).tolist()
    return [
        ("mirrors", b"", "empty"),
        ("mirrors", b"[1, 2]", "object"),
        ("mirrors", b"{", "JSON"),
        ("mirrors", b"\xff\xfe{}", "UTF-8"),
        ("mirrors", b"[" * 100_000, "JSON"),
        ("mirrors", b'{"a": ' * 5000 + b"1" + b"}" * 5000, "JSON"),
        ("mirrors", {}, "neither 'pose'"),
        ("mirrors", {"pose": pose["pose"], "covariance": pose["covariance"]}, "time_s"),
        ("mirrors", pose | {"time_s": float("nan")}, "not valid JSON"),
        ("mirrors", pose | {"time_s": 1e11}, "1e.10"),
        ("mirrors", pose | {"time_s": 10**400}, "line 1"),
        ("mirrors", pose | {"time_s": True}, "time_s"),
        ("mirrors", pose | {"covariance": [[1.0]]}, "covariance"),
        ("mirrors", pose | {"covariance": (-np.eye(6)).tolist()}, "positive definite"),
        ("mirrors", pose | {"covariance": (1e30 * np.eye(6)).tolist()}, "variances"),
        ("mirrors", pose | {"pose": {"quat_wxyz": [0, 0, 0, 0], "translation_m": [0, 0, 1]}},
         "quat_wxyz"),
        ("mirrors", pose | {"spots": [{"x_px": "far"}]}, "spots"),
        ("mirrors", pose | {"pose": 7}, "line 1"),
        ("ring", ring | {"ellipses": [{}]}, "centre_px"),
        ("ring", ring | {"poses": [ring["poses"][0] | {"axis": [0, 0, 5]}]}, "unit vector"),
        ("ring", ring | {"poses": [ring["poses"][0] | {"covariance": negative}]}, "negative"),
        ("laser", reach | {"range_m": -1.0}, "positive"),
        ("laser", reach | {"sigma_m": None}, "line 1"),
        ("camera", pose, "the session's own"),
        ("a/b", pose, "sensor"),
    ]  # fmt: skip


def test_what_is_no_line_is_refused_in_words_and_nothing_is_taken(session, sensors, tour):
    time_s, truth, image = tour[0]
    for sensor, content, said in _bad(sensors, truth):
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        path = f"{session._path}/measurements?sensor={sensor}"
        with pytest.raises(ServiceError, match=said) as refused:
            session.client.request("POST", path, body)
        assert refused.value.status == 422, (sensor, said)
    good = json.dumps(sensors.pose(1.0, truth)).encode()
    with pytest.raises(ServiceError, match="line 2"):
        session.client.request("POST", f"{session._path}/measurements?sensor=m", good + b"\n{}")
    assert len(session.info()["sensors"]) == 1
    assert "fused" not in session.track(image, time_s)


def test_limits_hold_for_lines_bytes_sensors_and_clocks(session, sensors, tour):
    _, truth, image = tour[0]
    session.track(image, 5.0)
    line = sensors.pose(5.0, truth)
    for time_s in (5.0 + 400.0, 5.0 - 400.0):
        with pytest.raises(ServiceError, match="one clock"):
            session.measure("mirrors", line | {"time_s": time_s})
    with pytest.raises(ServiceError, match="33 lines"):
        session.measure("mirrors", *[line] * 33)
    with pytest.raises(ServiceError) as refused:
        session.measure("mirrors", line | {"more": "x" * 300_000})
    assert refused.value.status == 413
    for k in range(8):
        session.measure(f"sensor-{k}", line)
    with pytest.raises(ServiceError, match="8 sensors"):
        session.measure("sensor-8", line)
    with pytest.raises(ServiceError, match="a name of its own"):
        session.measure("sensor-0", sensors.range(5.0, truth))
    statuses = []
    for _ in range(60):
        try:
            session.measure("sensor-0", *[line] * 32)
            statuses.append(200)
        except ServiceError as error:
            statuses.append(error.status)
    assert statuses[0] == 200
    assert set(statuses) <= {200, 429}


def test_a_stream_takes_lines_between_frames(session, sensors, tour):
    with session.stream() as stream:
        for time_s, truth, image in tour[:4]:
            time_s *= 20.0  # the tour turns faster than the filter expects
            stream.send(image, time_s)
            assert stream.receive(MOST_S)["pose"] is not None
            stream.measure("mirrors", sensors.pose(time_s, truth))
            told = stream.receive(MOST_S)
            Measured.model_validate(told)
        assert told["fused"]["status"] == "tracking"
        stream.measure("camera", sensors.pose(time_s, truth))
        with pytest.raises(ServiceError, match="own"):
            stream.receive(MOST_S)


def test_watchers_see_what_other_sensors_saw(session, sensors, tour):
    url = session.client.stream_url(session.name, "watch?rate_hz=100&image=0&contour=0")
    with connect(url, max_size=None) as socket:
        wait_until(lambda: session.info()["watchers"] == 1)
        time_s, truth, image = tour[0]
        session.measure("ring", sensors.ring(time_s, truth))
        session.measure("mirrors", sensors.pose(time_s, truth))
        session.track(image, time_s + 0.05)
        told = WatchState.model_validate(json.loads(socket.recv(MOST_S)))
    assert told.state.fused.pose is not None
    by_name = {marks.sensor: marks for marks in told.marks}
    assert by_name["ring"].ellipses[0].centre_px == [200.0, 180.5]
    assert by_name["ring"].chosen == 0
    assert by_name["mirrors"].spots_px == [[100.0, 120.5]]


def test_what_other_sensors_saw_is_kept_with_the_pictures(session, sensors, tour):
    time_s, truth, image = tour[0]
    session.track(image, time_s)  # the first picture: kept, before anything was seen in it
    session.measure("ring", sensors.ring(time_s, truth))
    path = f"/v1/sessions/{session.name}"
    numbers = itertools.count(1)

    def two_kept() -> list[int] | None:  # four a second are
        k = next(numbers)
        session.track(tour[k % len(tour)][2], time_s + 0.05 * k)
        kept = session.client.request("GET", f"{path}/history")["images"]
        return kept if len(kept) == 2 else None

    kept = wait_until(two_kept)
    assert session.client.request("GET", f"{path}/marks/{kept[0]}") == []
    (seen,) = session.client.request("GET", f"{path}/marks/{kept[1]}")
    assert Marks.model_validate(seen).ellipses[0].centre_px == [200.0, 180.5]
    assert session.client.request("GET", f"{path}/marks/{kept[1] + 3}") == [seen]
    with pytest.raises(ServiceError, match="frame -1"):
        session.client.request("GET", f"{path}/marks/-1")


def test_a_run_of_several_sensors_is_logged_and_repeated_bit_for_bit(
    service, session, sensors, tour
):
    answers, sent = [], []
    for time_s, truth, image in tour[:8]:
        session.track(image, time_s)
        sent += [sensors.ring(time_s + 0.01, truth), sensors.range(time_s - 0.15, truth)]
        answers.append(session.measure("ring", sent[-2]))
        answers.append(session.measure("laser", sent[-1]))
    log_name = session.info()["recording"]["name"]
    session.close()
    with open(service.folder / log_name, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        kept = [
            LoggedMeasurement.model_validate_json(message.data)
            for _, _, message in reader.iter_messages(topics=["/rendezview/measurement"])
        ]
        fused = [m for *_, m in reader.iter_decoded_messages(topics=["/target/fused"])]
    assert [line.order for line in kept] == list(range(16))
    assert [line.record for line in kept] == sent
    assert [line.verdict.model_dump() for line in kept] == [a["verdicts"][0] for a in answers]
    last = answers[-1]["fused"]["pose"]
    assert fused[-1].pose.position.z == last["translation_m"][2]
    assert fused[-1].pose.orientation.w == last["quat_wxyz"][0]
    log = read_log(service.folder / log_name)
    *_, (_, so_far) = repeat(log, model_of(log, None))
    assert (so_far.frames, so_far.lines, so_far.differing, so_far.gap) == (8, 16, 0, None)


@pytest.fixture(scope="module")
def ringed(start_service, tmp_path_factory):
    """A service of its own: its target has a ring, and its worker may end."""
    folder = tmp_path_factory.mktemp("ringed")
    (folder / "mesh.stl").write_text("solid\nendsolid\n")
    (folder / "target.toml").write_text(
        'name = "bumpy"\n[mesh]\npath = "mesh.stl"\nunit = "m"\n[docking_ring]\n'
        f"centre_m = {RING.centre_m.tolist()}\naxis = {RING.axis.tolist()}\nradius_m = 0.5\n"
    )
    served = start_service("--target", str(folder / "target.toml"))
    yield served
    served.stop()


def test_a_filter_that_ends_with_its_process_is_said_to_have_begun_anew(
    ringed, sensors, camera, tour
):
    served = ringed
    with served.client() as client:
        session = client.open(camera, prior=tour[0][1], fusion={"ring": RING}, sensors=POSTED)
        for time_s, truth, image in tour[:4]:
            session.track(image, time_s)
            session.measure("mirrors", sensors.pose(time_s, truth))
        os.kill(served.workers[0], signal.SIGKILL)
        time_s, _, image = tour[4]

        def tracked() -> dict | None:
            with contextlib.suppress(ServiceError):
                return session.track(image, time_s + 100.0)
            return None

        state = wait_until(tracked)
        assert "process ended" in state["fused"]["reason"]
        assert state["fused"]["status"] in ("waiting", "starting")
        mirrors = session.info()["sensors"][1]["reason"]
        # On a slow machine the new process needs longer than a sensor may be silent.
        assert "a new one starts" in mirrors or mirrors.startswith("no line for")
        told = session.measure("mirrors", sensors.pose(time_s + 100.0, tour[4][1]))
        assert told["verdicts"][0]["time_s"] == time_s + 100.0
        session.close()


def test_a_target_gives_its_ring_to_sessions_that_say_none(ringed, sensors, camera, tour):
    with ringed.client() as client:
        session = client.open(camera, prior=tour[0][1], sensors=POSTED)
        assert (
            session.measure("ring", sensors.ring(0.0, tour[0][1]))["fused"]["status"] == "waiting"
        )
        session.close()
