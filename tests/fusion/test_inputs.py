"""Inputs that are known: the camera's own rotation and thrusts; and lateness that is estimated."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.fusion.scenes import SIGMA, World, drift

from rendezview.fusion import (
    Fusion,
    FusionOptions,
    PoseMeasurement,
    RateMeasurement,
    SensorOptions,
    ThrustMeasurement,
)
from rendezview.fusion.logs import LogContext, kind_of, read_record
from rendezview.geometry.pose import Pose

SWING = np.array([0.02, -0.015, 0.01])  # rad/s, of the camera
STARTS_S = 16.0


def swung(time_s: float) -> Pose:
    """As seen by a camera that begins to turn: what it sees turns the other way."""
    since_s = max(time_s - STARTS_S, 0.0)
    still, turn = drift(time_s), Rotation.from_rotvec(-SWING * since_s).as_matrix()
    return Pose(turn @ still.rotation, turn @ still.translation_m)


def test_a_gyroscope_carries_the_attitude_through_a_gap():
    world, with_it, without = World(1, swung), Fusion(), Fusion()
    for k in range(240):
        time_s = 0.1 * k
        turning = SWING if time_s > STARTS_S else np.zeros(3)
        if k > 0:
            with_it.add(RateMeasurement(time_s, "gyro", turning, 1e-4))
        if k % 5 == 0 and time_s <= STARTS_S:  # then no pose for 8 s
            pose = world.pose(time_s)
            with_it.add(pose)
            without.add(pose)
    known, guessed = with_it.state_at(23.9), without.state_at(23.9)
    off = world.error(known.pose, world.truth(23.9))
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(known.covariance)[:6]))
    assert np.linalg.norm(off[:3]) < 0.02
    assert np.linalg.norm(world.error(guessed.pose, world.truth(23.9))[:3]) > 0.15


def test_a_thrust_within_a_gyroscopes_interval_takes_no_part_of_its_turn():
    """A push of nothing, in the middle of each interval of a rate that changes."""
    rng, tells, alone = np.random.default_rng(3), Fusion(), Fusion()
    world = World(3)
    for fusion in (tells, alone):
        for k in range(20):
            pose = world.truth(0.5 * k)
            fusion.add(PoseMeasurement(0.5 * k, "camera", pose, np.diag(SIGMA**2)))
        fusion.add(RateMeasurement(9.5, "gyro", np.zeros(3), 1e-4))
    for k in range(20, 25):
        time_s, rate = 0.5 * k, 0.02 * rng.standard_normal(3)
        tells.add(ThrustMeasurement(time_s - 0.25, "thrust", np.zeros(3), 1e-9))
        for fusion in (tells, alone):
            fusion.add(RateMeasurement(time_s, "gyro", rate, 1e-4))
    one, other = (fusion.state_at(12.0).pose for fusion in (tells, alone))
    assert one.angle_to(other) < 2e-4  # 5 mrad with the first half of each at the rate before


def test_a_thrust_that_is_told_is_no_surprise():
    change = np.array([0.3, -0.2, 0.1])  # of the camera: the target moves the other way

    def path(time_s: float) -> Pose:
        pushed = -change * max(0.0, time_s - 20.0)
        still = drift(time_s)
        return Pose(still.rotation, still.translation_m + pushed)

    told, untold = Fusion(), Fusion()
    world, rejected = World(2, path), {"told": 0, "untold": 0}
    for k in range(61):
        time_s, pose = 0.5 * k, world.pose(0.5 * k)
        for name, fusion in (("told", told), ("untold", untold)):
            rejected[name] += not fusion.add(pose).accepted
        if k == 40:
            told.add(ThrustMeasurement(time_s, "thrusters", change, 0.005))
            estimate = told.state_at(time_s + 2.0)
            off = world.error(estimate.pose, path(time_s + 2.0))
            assert np.linalg.norm(off[3:]) < 0.15
    assert rejected["told"] == 0
    assert told.starts == 1


def test_lines_of_a_gyroscope_and_of_thrusters_are_read_in_the_camera_frame():
    mount = Pose(Rotation.from_rotvec([0.0, 0.0, 0.5 * np.pi]).as_matrix(), np.zeros(3))
    context = LogContext(mounts={"gyro": mount, "jets": mount})
    gyro = {"time_s": 1.0, "rate_rad_s": [0.1, 0.0, 0.0], "sigma_rad_s": 1e-4}
    found = read_record(gyro, kind_of(gyro, ""), "gyro", context, "here")
    assert isinstance(found, RateMeasurement)
    assert found.rate_rad_s == pytest.approx([0.0, -0.1, 0.0])
    jets = {"time_s": 1.0, "velocity_change_m_s": [0.0, 0.2, 0.0], "sigma_m_s": 0.01}
    found = read_record(jets, kind_of(jets, ""), "jets", context, "here")
    assert isinstance(found, ThrustMeasurement)
    assert found.velocity_change_m_s == pytest.approx([0.2, 0.0, 0.0])
    assert read_record(gyro | {"rate_rad_s": None}, "rate", "gyro", context, "") is None
    with pytest.raises(ValueError, match="sigma_rad_s must be positive"):
        RateMeasurement(0.0, "gyro", np.zeros(3), 0.0)
    with pytest.raises(ValueError, match="three finite numbers"):
        ThrustMeasurement(0.0, "jets", np.array([np.nan, 0.0, 0.0]), 0.1)


def test_a_sensor_that_is_late_by_a_constant_is_put_right():
    late_s = 0.6
    options = FusionOptions(sensors={"camera": SensorOptions(late_s=0.5)})
    world, known, taken_for_right = World(3), Fusion(options), Fusion()
    for k in range(240):
        time_s = 0.5 * k
        seen = world.truth(time_s - late_s).perturbed(SIGMA * world.rng.standard_normal(6))
        camera = PoseMeasurement(time_s, "camera", seen, np.diag(SIGMA**2))
        stereo = world.pose(time_s, sensor="stereo")
        for fusion in (known, taken_for_right):
            fusion.add(stereo)
            fusion.add(camera)
    off = [
        np.linalg.norm(world.error(f.state_at(119.5).pose, world.truth(119.5))[3:])
        for f in (known, taken_for_right)
    ]
    assert off[0] < 0.5 * off[1]
    assert off[0] < 0.03


@pytest.mark.parametrize(
    "wrong",
    [
        ThrustMeasurement(10.2, "known", np.array([5.0, 0.0, 0.0]), 0.02),
        RateMeasurement(10.2, "known", np.array([0.0, 3.0, 0.0]), 1e-3),
    ],
)
def test_an_input_that_is_wrong_once_is_within_the_level_and_gone_with_the_next_pose(wrong):
    """Without a doubt of it, two sensors contradicted a state that stayed lost for 30 s."""
    world, fusion = World(4), Fusion()
    for k in range(21):
        fusion.add(world.pose(0.5 * k))
    fusion.add(wrong)
    off = world.error(fusion.state_at(10.4).pose, world.truth(10.4))
    levels = fusion.state_at(10.4).protection
    assert np.linalg.norm(off[3:]) > 0.5  # or nothing is tested
    assert np.linalg.norm(off[3:]) <= levels.position_m
    assert np.linalg.norm(off[:3]) <= levels.attitude_rad
    for k in range(21, 25):
        fusion.add(world.pose(0.5 * k))
        estimate = fusion.state_at(0.5 * k)
        off = world.error(estimate.pose, world.truth(0.5 * k))
        assert np.all(np.abs(off) < 5.0 * np.sqrt(np.diag(estimate.covariance)[:6]))
        assert np.linalg.norm(off[3:]) < 0.3
        assert estimate.protection.alarm
    assert fusion.starts == 1
