"""Ring, reflectors and path on the frames of a session, without a service."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from tests.service.sensors import RING, Sensors, observed, plain

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.beacons import LitDark, ReflectorPattern, ReflectorSensor
from rendezview.sensors.observation import Observation, Status
from rendezview.sensors.ring import RingPrior, RingSensor
from rendezview_ground.simulate.reflector_frames import ReflectorFrameOptions, render_pair
from rendezview_ground.simulate.ring_frames import RingSceneOptions, random_scene, render_ring_frame
from rendezview_ground.simulate.sensor import SensorOptions
from rendezview_service.client.messages import camera_message as sent_by_client
from rendezview_service.hub.progress import Progress
from rendezview_service.hub.session_defaults import SessionDefaults
from rendezview_service.messages.frame_sensor_messages import RingReading
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.messages.messages import SessionRequest, State
from rendezview_service.settings import Settings
from rendezview_service.tracker.session_filter import SessionFilter
from rendezview_service.tracker.tracking import SessionTracker, camera_message, camera_of
from rendezview_service.worker.worker_models import Sight

PAPER = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)
FOUR = ReflectorPattern(  # the fourth tells the roll
    "small",
    ("left", "post", "right", "top"),
    np.array([[-0.18, 0.0, 0.0], [0.0, 0.0, 0.1], [0.18, 0.0, 0.0], [0.0, 0.13, 0.0]]),
    np.tile([0.0, 0.0, 1.0], (4, 1)),
    np.full(4, 0.025),
)
REFLECTORS = [
    {"name": name, "group": "small", "position_m": place.tolist(), "normal": [0.0, 0.0, 2.0],
     "diameter_m": 0.025}
    for name, place in zip(FOUR.names, FOUR.positions_m, strict=True)
]  # fmt: skip
PLAN = {"vbar": {"axis": [-1.0, 0.0, 0.0], "distance_m": 9.0, "speed_m_s": 0.01}}


class STORED:
    """A model of a target without ring and reflectors, as the service keeps it."""

    name = "bumpy"
    known, centre_m = (None, ()), np.zeros(3)


def filled(camera: Camera, settings: Settings | None = None, **asked: Any) -> SessionRequest:
    """A request as the service passes it to a worker."""
    request = SessionRequest.model_validate(plain(asked) | {"camera": camera_message(camera)})
    return SessionDefaults(settings or Settings()).filled(request, "one", STORED)


@pytest.mark.parametrize("target", ["client", None])
def test_what_runs_by_default_is_what_the_target_has(camera, target):
    folder = None if target is None else find_target(target).mesh_path.parent
    request = filled(camera, Settings(target=folder))
    runs = request.sensors
    has = target is not None
    assert (runs.ring, runs.fusion, bool(runs.trajectory), runs.any) == (has,) * 4
    assert runs.reflectors == "off"  # nobody says how the lights are shown
    if has:
        assert runs.trajectory.shape == "vbar"
        assert [one.name for one in request.fusion.reflectors][:2] == ["far-left", "far-middle"]
    assert filled(camera, Settings(target=folder), sensors={"ring": False}).sensors.ring is False


def test_a_plan_of_the_service_is_followed(camera, tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text("[vbar]\naxis = [-1, 0, 0]\ndistance_m = 9.0\nspeed_m_s = 0.01\n")
    runs = filled(camera, Settings(plan=plan)).sensors
    assert runs.trajectory.plan.vbar.distance_m == 9.0
    assert (runs.ring, runs.fusion) == (False, False)
    shaped = filled(camera, Settings(plan=plan), sensors={"trajectory": {"shape": "orbit"}})
    assert (shaped.sensors.trajectory.shape, shaped.sensors.trajectory.plan is None) == (
        "orbit", False,
    )  # fmt: skip
    assert filled(
        camera, Settings(plan=plan), sensors={"trajectory": False}
    ).sensors.trajectory is (False)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"sensors": {"ring": True}}, "which ring"),
        ({"sensors": {"reflectors": "single"}}, "which ones"),
        ({"sensors": {"trajectory": True}}, "what path"),
        ({"sensors": {"trajectory": {"plan": {"vbar": None}}}}, "0 paths"),
        (
            {"fusion": {"reflectors": REFLECTORS[:2]}, "sensors": {"reflectors": "pairs"}},
            "a pose needs three",
        ),
    ],
)
def test_what_a_session_lacks_is_told(refining_model, camera, asked, said):
    with pytest.raises(RendezviewError, match=said):
        SessionTracker("one", refining_model, filled(camera, **asked))


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"sensors": {"reflectors": "both"}}, "single"),
        ({"sensors": {"trajectory": {"shape": "loop"}}}, "circular"),
        ({"sensors": {"more": 1}}, "more"),
        ({"fusion": {"reflectors": REFLECTORS[:1] * 2}}, "a name of its own"),
        (
            {"fusion": {"reflectors": [REFLECTORS[0] | {"name": str(k)} for k in range(9)]}},
            "at most 8",
        ),
    ],
)
def test_impossible_sensors_are_refused(asked, said):
    with pytest.raises(ValidationError, match=said):
        SessionRequest.model_validate(asked)


def test_the_ring_is_read_where_the_fused_state_expects_it_and_fused(refining_model):
    """The recognizer finds nothing in these frames: another sensor has the pose."""
    camera, rng = Camera.from_fov(640, 480, np.deg2rad(40.0)), np.random.default_rng(5)
    drawn = random_scene(camera, rng, RingSceneOptions())
    scene = drawn.ring
    ring = {"centre_m": [0, 0, 0], "axis": [0, 0, 1], "radius_m": scene.radius_m}
    tracker = SessionTracker("one", refining_model, filled(camera, fusion={"ring": ring}))
    away = np.cross([0.0, 0.0, 1.0], scene.axis)
    turn = np.arctan2(np.linalg.norm(away), scene.axis[2]) * away / np.linalg.norm(away)
    pose = Pose.identity().perturbed(np.concatenate([turn, scene.centre_m]))
    known = Sensors(7)
    alone = RingSensor(camera, scene.radius_m)
    for k in range(6):
        image = render_ring_frame(drawn, rng, SensorOptions(noise_sigma_grey=3.0))
        (line,) = tracker.filter.check("m", json.dumps(known.pose(k, pose)).encode(), float(k))
        tracker.filter.take("m", line)
        expected = tracker.filter.state_at(float(k))
        state, _ = tracker.track(image, float(k), 0.0)
        State.model_validate(state)
        seen = RingReading.model_validate(state["ring"])
        axis = np.array(seen.poses[0].axis) if seen.poses else scene.axis
        direct = alone.update(float(k), image, RingPrior(scene.centre_m, axis))
        if seen.status == "ok":
            assert seen.ellipse.centre_px == direct.edges[direct.edge].ellipse.centre_px.tolist()
            assert np.array(seen.poses[0].centre_m) == pytest.approx(scene.centre_m, rel=0.01)
            assert seen.verdict.accepted
            # The state has the reading in it: it is surer than before.
            before, after = (np.array(s["covariance"]) for s in (expected, state["fused"]))
            assert np.trace(after[3:6, 3:6]) < np.trace(before[3:6, 3:6])
    assert seen.status == "ok"
    assert tracker.filter.health()["ring"]["heard"] == 6


def test_a_pair_of_frames_is_a_reading_and_a_dropped_frame_costs_one_pair(refining_model):
    request = filled(PAPER, fusion={"reflectors": REFLECTORS}, sensors={"reflectors": "pairs"})
    tracker = SessionTracker("one", refining_model, request)
    direct = ReflectorSensor(PAPER, [FOUR])
    rng = np.random.default_rng(3)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.05, 0.02, 3.0]))
    pairs = [render_pair(PAPER, FOUR, pose, ReflectorFrameOptions(), rng) for _ in range(5)]
    states, drops = [], 0
    for k, (lit, dark) in enumerate(pairs):
        states.append(tracker.track(lit, k + 0.0, 0.0, drops)[0])
        if k == 1:
            drops += 1  # its dark frame was replaced by the next lit one
            continue
        states.append(tracker.track(dark, k + 0.5, 0.0, drops)[0])
    readings = [state["reflectors"] for state in states]
    assert [reading is None for reading in readings] == [
        True, False, True, True, False, True, False, True, False,
    ]  # fmt: skip
    given = [reading for reading in readings if reading is not None]
    expected = [direct.update(float(k), LitDark(*pairs[k])) for k in (0, 2, 3, 4)]
    assert [reading["status"] for reading in given] == [str(one.status) for one in expected]
    for reading, one in zip(given, expected, strict=True):
        assert reading["time_s"] == one.time_s
        if one.pose is not None:
            assert reading["pose"] == plain(one.pose)
            assert reading["verdict"]["time_s"] == one.time_s
    assert given[-1]["pose"]["translation_m"] == pytest.approx(pose.translation_m, rel=0.01)
    State.model_validate(states[-1])
    fused = states[-1]["fused"]  # half a second after the last reading
    off = np.array(fused["pose"]["translation_m"]) - pose.translation_m
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(fused["covariance"]))[3:6])
    assert np.abs(off).max() < 0.01
    assert "ring" not in states[-1]


def test_the_path_is_that_of_the_follower_and_has_a_correction(refining_model, camera, tour):
    request = filled(
        camera, prior=tour[0][1].as_dict(), sensors={"trajectory": {"plan": PLAN, "shape": "vbar"}}
    )
    tracker = SessionTracker("one", refining_model, request)
    states = [tracker.track(image, 10.0 * time_s, 0.0)[0] for time_s, _, image in tour[:12]]
    for state in states:
        State.model_validate(state)
    last = states[-1]["trajectory"]
    assert last["time_s"] == states[-1]["time_s"]
    assert last["centre_m"] == refining_model.centre_m.tolist()
    back = tour[11][1].inverse().translation_m - refining_model.centre_m
    assert last["segment"]["path_m"][-1] == pytest.approx(back, abs=1.0)
    assert ("correction_reason" in last) or (last["correction"] is not None)
    assert "fused" not in states[-1]  # the camera is the only sensor


def test_frames_that_come_fast_are_not_all_fitted(refining_model, camera, tour):
    request = filled(camera, prior=tour[0][1].as_dict(), sensors={"trajectory": {"shape": "vbar"}})
    tracker = SessionTracker("one", refining_model, request)
    times = [0.0, 50.0, 50.1, 50.2, 50.3, 50.6]
    fitted = [
        tracker.track(tour[k][2], time_s, 0.0)[0]["trajectory"]["time_s"]
        for k, time_s in enumerate(times)
    ]
    assert fitted == [0.0, 50.0, 50.0, 50.0, 50.0, 50.6]


def test_a_target_that_turns_fast_is_followed(refining_model, camera, tour):
    request = filled(camera, prior=tour[0][1].as_dict(), sensors={"fusion": True})
    tracker = SessionTracker("one", refining_model, request)
    states = [tracker.track(image, time_s, 0.0)[0] for time_s, _, image in tour[:8]]  # 19°/s
    assert states[-1]["fused"]["status"] == "tracking"
    slow = SessionTracker("one", refining_model, request)
    states = [slow.track(image, 20.0 * time_s, 0.0)[0] for time_s, _, image in tour[:8]]
    assert states[-1]["fused"]["status"] == "tracking"
    assert states[-1]["motion"]["pose"] == states[-1]["fused"]["pose"]


def test_a_line_under_the_name_of_an_own_sensor_is_refused():
    own = SessionFilter(FusionRequest(ring=plain(RING)), own=["ring"], at_once=True)
    line = json.dumps(Sensors().ring(0.0, Pose.identity())).encode()
    with pytest.raises(RendezviewError, match="reads it in its frames"):
        own.check("ring", line, 0.0)
    assert own.check("rim", line, 0.0)[0].kind == "ring"


def test_the_next_filter_goes_on_where_the_last_one_was(tour):
    """No camera pose comes any more: rings alone cannot start a filter, but they keep it."""
    truth = tour[0][1]
    first = SessionFilter(FusionRequest(ring=plain(RING)), own=["ring"], at_once=True)
    for k in range(6):
        state = first.track(observed(float(k), truth))
    progress = Progress()
    progress.add({"phase": "tracking", "time_s": 5.0}, json.dumps({"fused": state}).encode())
    second = SessionFilter(FusionRequest(ring=plain(RING)), forgotten=True, own=["ring"])
    second.resume(progress.handover)
    lines = Sensors(4)
    for k in range(6, 12):
        state = second.track(Observation(Status.BORDER, time_s=float(k)))
        assert state["status"] == "tracking"
        (line,) = second.check("rim", json.dumps(lines.ring(float(k), truth)).encode(), float(k))
        verdict, state = second.take("rim", line)
        assert verdict["accepted"]
    assert state["pose"]["translation_m"] == pytest.approx(truth.translation_m, abs=0.05)
    late = second.track(observed(4.0, truth))
    assert (late["status"], late["pose"]) == ("late", None)
    assert "before the earliest remembered time" in late["reason"]


def test_a_model_brings_the_ring_of_its_target(refining_model, camera, tmp_path):
    target = find_target("client")
    known = replace(refining_model, docking_ring=target.docking_ring, reflectors=target.reflectors)
    known.save(tmp_path / "known.rvm")
    read = ViewModel.load(tmp_path / "known.rvm")
    stored = SimpleNamespace(
        name="known", known=(read.docking_ring, read.reflectors), centre_m=read.centre_m
    )
    request = SessionRequest(camera=camera_message(camera))
    full = SessionDefaults(Settings()).filled(request, "one", stored)
    assert (full.sensors.ring, full.sensors.trajectory.shape) == (True, "vbar")
    by_file = filled(camera, Settings(target=target.mesh_path.parent))
    assert full.fusion == by_file.fusion
    many = tuple(replace(target.reflectors[0], name=str(k)) for k in range(9))
    stored.known = read.docking_ring, many
    assert SessionDefaults(Settings()).filled(request, "one", stored).fusion.reflectors == []


def test_a_session_keeps_the_covariance_of_its_camera(camera):
    spread = np.diag([1.0, 1.0, 4.0, 9.0]).tolist()
    known = replace(camera, covariance=spread)
    for message in (camera_message(known).model_dump(mode="json"), sent_by_client(known)):
        request = SessionRequest.model_validate(json.loads(json.dumps({"camera": message})))
        full = SessionDefaults(Settings()).filled(request, "one", STORED)
        asked = {"model_path": "one.rvm", "camera": full.model_dump()["camera"], "trees": True}
        assert Sight.of(asked).camera == known  # of the worker
    wrong = camera_message(known).model_copy(update={"covariance": [[1.0, 0.0], [0.0, 1.0]]})
    with pytest.raises(RendezviewError, match="camera: covariance must be of 4 numbers"):
        camera_of(wrong)


@pytest.mark.parametrize("told", [True, False])
def test_a_lost_target_is_searched_where_the_other_sensors_expect_it(
    refining_model, bumpy_mesh, camera, draw, told
):
    """Fifty dark frames while the target turns by 100°; another sensor goes on seeing it.

    Without it, a second frame confirms the turn.
    """
    tracker = SessionTracker("one", refining_model, filled(camera, fusion={}))
    known, rng = Sensors(7), np.random.default_rng(4)
    start = Rotation.from_rotvec([0.4, -0.7, 0.2])
    for k in range(60):
        turned = Rotation.from_rotvec([0.0, np.deg2rad(2.0 * k), 0.0]) * start
        rotation = turned.as_matrix()
        centre = np.array([0.0, 0.0, 1.6 * refining_model.sphere_radius_m])
        pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
        dark = 8 <= k < 58
        image = np.zeros((camera.height, camera.width), np.uint8)
        image = image if dark else draw(bumpy_mesh, pose, camera, rng)
        if told:
            (line,) = tracker.filter.check("m", json.dumps(known.pose(k, pose)).encode(), float(k))
            tracker.filter.take("m", line)
        state, seen = tracker.track(image, float(k), 0.0)
        assert (state["status"] == "ok") != (dark or (k == 58 and not told))
        if k == 58:
            assert seen.found.prior == told  # else all attitudes were searched
    assert np.rad2deg(seen.pose.angle_to(pose)) < 1.0
    assert tracker.tracker.lost is False
