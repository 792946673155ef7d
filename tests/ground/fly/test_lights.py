"""A stereo pair looks at the target's lights in the loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.ground.fly.conftest import short_plan

from rendezview.fusion import PoseMeasurement
from rendezview.geometry import so3
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.sensors.beacons import Rig
from rendezview_ground.fly.campaign import fly_once
from rendezview_ground.fly.dynamics import OrbitDynamics
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.lights import StereoPair
from rendezview_ground.fly.live import LiveSensors
from rendezview_ground.fly.options import PortOptions
from rendezview_ground.fly.sensors import ModelledSensors
from rendezview_ground.fly.setup import Setup
from rendezview_ground.mesh.mesh import load_mesh


@pytest.fixture(scope="module")
def scole() -> Setup:
    """3 m before a port on the face with the lights."""
    target = find_target("scole")
    port = PortOptions(centre_m=(0.3, 0.0, -0.03), axis=(0.0, 0.0, -1.0))
    plan = replace(short_plan(), port=port)
    return Setup.of(target, load_mesh(target.mesh_path, target.unit), plan)


def facing(setup: Setup, away_m: float, turn: np.ndarray | None = None) -> Pose:
    """The chaser's camera before the port, and turned."""
    rotation = so3.exp(np.zeros(3) if turn is None else turn) @ setup.port.facing
    return Pose(rotation, np.array([0.0, 0.0, away_m]) - rotation @ setup.port.centre_m)


def pair_of(setup: Setup) -> StereoPair:
    pair = setup.stereo_pair()
    assert pair is not None
    return pair


def test_a_light_is_seen_from_its_own_side_and_not_through_the_craft(scole):
    pair, pose = pair_of(scole), facing(scole, 5.0)
    assert len(pair.shining(0, pose)) == len(pair.shining(1, pose)) == 6
    behind = Pose(np.diag([-1.0, 1.0, -1.0]) @ pose.rotation, np.array([0.0, 0.0, 5.0]))
    assert len(pair.shining(0, behind)) == 0
    pair.tracker.leds = np.add(pair.tracker.leds, [0.0, 0.0, 0.2])  # under the plate
    assert len(pair.shining(0, pose)) == 0


def test_the_right_camera_is_a_baseline_beside_the_left(scole):
    pair = pair_of(scole)
    assert isinstance(pair.rig, Rig)
    left, right = (camera.project([[0.0, 0.0, 10.0]])[0] for camera in pair.rig.cameras)
    base = scole.plan.sensors.stereo_baseline_m
    np.testing.assert_allclose(left - right, [pair.camera.fx * base / 10.0, 0.0])


def test_the_errors_of_its_poses_are_those_that_it_claims(scole):
    rng, squares = np.random.default_rng(4), []
    for _ in range(60):
        pose = facing(scole, 8.0, np.deg2rad(rng.normal(0.0, 3.0, 3)))
        pair = pair_of(scole)
        seen = pair.read(0.0, pair.modelled(pose, scole.plan.sensors.led_px, rng))
        assert seen.pose is not None, seen.reason
        turn = so3.log(np.ascontiguousarray(seen.pose.rotation @ pose.rotation.T))
        error = np.append(turn, seen.pose.translation_m - pose.translation_m)
        squares.append(error @ np.linalg.solve(seen.covariance, error))
    assert 4.5 < np.mean(squares) < 7.5


def test_pictures_of_a_sunlit_craft_give_the_same_pose(scole):
    rng, pose, pair = np.random.default_rng(5), facing(scole, 6.0), pair_of(scole)
    scene = np.zeros((1024, 1024), np.float32)
    scene[:, 500:] = 30.0  # an edge of light through the pattern
    seen = pair.read(0.0, pair.pictured(pose, (scene, scene), rng))
    assert seen.pose is not None, seen.reason
    assert seen.pose.angle_to(pose) < np.deg2rad(0.1)


def test_a_flight_to_a_craft_with_lights_uses_them_and_docks(scole):
    flight = fly_once(scole, 0)
    assert (flight.end, flight.outside) == ("contact", None)
    assert sum("stereo" in moment.used for moment in flight.moments) > 10


def test_too_far_away_or_with_a_dead_camera_there_is_no_reading(scole):
    def readings(plan, fault=None):
        sensors = ModelledSensors(replace(scole, plan=plan, patterns=()), 0, fault)
        truth = OrbitDynamics(plan, scole.port, 0).start()
        found = [m for m in sensors.read(truth, None) if m.sensor == "stereo"]
        assert all(isinstance(m, PoseMeasurement) for m in found)
        return len(found)

    near = replace(scole.plan, sensors=replace(scole.plan.sensors, stereo_m=1.0))
    assert readings(scole.plan) == 1
    assert readings(near) == 0
    assert readings(scole.plan, Fault("camera", 0.0, 9.0, 0.0)) == 0


def test_a_live_flight_sends_its_lines_and_the_operator_may_switch_it_off(scole, setup):
    sensors = LiveSensors(scole, 0)
    truth = OrbitDynamics(scole.plan, scole.port, 0).start()
    sent = dict(sensors.read(truth, None))
    assert sent["stereo"]["status"] == "ok"
    sensors.on["stereo"] = False
    again = dict(sensors.read(replace(truth, time_s=truth.time_s + 2.0), None))
    assert "camera" in again
    assert "stereo" not in again
    assert "stereo" not in LiveSensors(setup, 0).on
