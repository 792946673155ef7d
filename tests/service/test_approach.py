"""The numbers of an approach against differences of known motions, and limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview_service.messages.approach_messages import Approach, ApproachRequest
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.tracker.approach import ApproachMonitor

PORT = {"centre_m": [-1.6, 0.2, 0.1], "axis": [-2.0, 0.0, 0.0]}
COVARIANCE = np.diag([1e-4] * 3 + [4e-4] * 3 + [1e-6] * 3 + [1e-4] * 3)


def monitor(**asked: Any) -> ApproachMonitor:
    request = ApproachRequest.model_validate({"port": PORT} | asked)
    return ApproachMonitor(request, None, np.zeros(3))


def motion_of(pose: Pose, turn=(0.0, 0.0, 0.0), move=(0.0, 0.0, 0.0)) -> dict[str, Any]:
    rates = {"angular_rad_s": list(turn), "linear_m_s": list(move)}
    return {"pose": pose.as_dict(), "rates": rates, "status": "tracking", "reason": None}


def aligned(along_m: float, right_m: float = 0.0, up_m: float = 0.0) -> Pose:
    """camera_from_target of a chaser before PORT: boresight along +x, up along +z."""
    # Seen along +x with z up, the right is −y.
    camera_from_target = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    place = np.add(PORT["centre_m"], [-along_m, -right_m, up_m])
    return Pose(camera_from_target, -camera_from_target @ place)


def test_an_aligned_chaser_has_no_misalignment_and_its_distances():
    state = monitor().state(0.0, motion_of(aligned(5.0, 0.3, 0.4)), COVARIANCE)
    assert state["range_m"] == pytest.approx(math.sqrt(25.0 + 0.25))
    assert [state["along_m"], state["right_m"], state["up_m"]] == pytest.approx([5.0, 0.3, 0.4])
    assert [state["roll_rad"], state["pitch_rad"], state["yaw_rad"]] == pytest.approx([0, 0, 0])
    assert state["azimuth_rad"] == pytest.approx(math.atan2(-0.3, 5.0))
    assert state["elevation_rad"] == pytest.approx(math.atan2(-0.4, math.hypot(5.0, 0.3)))
    assert state["off_axis_rad"] == pytest.approx(math.atan2(0.5, 5.0))
    Approach.model_validate(state)


def test_misalignments_are_the_turns_of_the_chaser():
    yaw, pitch, roll = 0.1, -0.05, 0.2
    chaser = Rotation.from_euler("YXZ", [yaw, pitch, roll]).as_matrix()  # port_from_camera
    start = aligned(5.0)
    pose = Pose(chaser.T @ start.rotation, chaser.T @ start.translation_m)
    state = monitor().state(0.0, motion_of(pose), COVARIANCE)
    assert [state["yaw_rad"], state["pitch_rad"], state["roll_rad"]] == pytest.approx(
        [yaw, pitch, roll]
    )
    # Turned to the right: the port is seen on the left.
    assert state["azimuth_rad"] < 0.0
    assert state["along_m"] == pytest.approx(5.0)


def test_rates_are_the_differences_of_the_numbers():
    rng = np.random.default_rng(4)
    lever = Pose(Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix(), np.array([0.2, 0.5, -0.4]))
    watch = monitor(probe_from_camera=lever.as_dict())
    for _ in range(20):
        start = Pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3) * 5.0)
        turn, move = rng.normal(size=3) * 0.1, rng.normal(size=3)

        def pose_at(dt, start=start, turn=turn, move=move):
            rotation = Rotation.from_rotvec(turn * dt).as_matrix() @ start.rotation
            return Pose(rotation, start.translation_m + move * dt)

        def state_at(dt, turn=turn, move=move, pose_at=pose_at):
            return watch.state(0.0, motion_of(pose_at(dt), turn, move), COVARIANCE)

        now, before, after = state_at(0.0), state_at(-1e-4), state_at(1e-4)
        for place, rate in (
            ("range_m", "range_rate_m_s"),
            ("along_m", "along_rate_m_s"),
            ("right_m", "right_rate_m_s"),
            ("up_m", "up_rate_m_s"),
        ):
            assert now[rate] == pytest.approx((after[place] - before[place]) / 2e-4, abs=1e-5)


def test_the_range_sigma_is_that_of_drawn_poses():
    rng = np.random.default_rng(5)
    pose, watch = aligned(5.0, 1.0, -0.5), monitor()
    sigma = np.sqrt(np.diag(COVARIANCE))[:6]
    ranges = [
        watch.state(0.0, motion_of(pose.perturbed(rng.normal(size=6) * sigma)), COVARIANCE)
        for _ in range(4000)
    ]
    said = watch.state(0.0, motion_of(pose), COVARIANCE)["range_sigma_m"]
    assert np.std([state["range_m"] for state in ranges]) == pytest.approx(said, rel=0.05)


def test_a_chaser_that_closes_has_a_contact_and_a_miss():
    pose = aligned(5.0, 0.3)
    state = monitor().state(0.0, motion_of(pose, move=(0.0, 0.02, -0.5)), COVARIANCE)
    assert state["contact_s"] == pytest.approx(10.0)
    # The target moves down in the picture: the chaser moves up.
    assert state["miss_m"] == pytest.approx(math.hypot(0.3, 0.2))
    away = monitor().state(0.0, motion_of(pose, move=(0.0, 0.0, 0.5)), COVARIANCE)
    assert away["contact_s"] is None


def test_corridor_zone_limits_and_plan_are_compared():
    watch = monitor(
        corridor={"half_angle_deg": 10.0, "radius_m": 0.1, "length_m": 20.0},
        keep_out_m=12.0,
        limits=[
            {"quantity": "range_rate_m_s", "least": -0.3, "within_m": 10.0},
            {"quantity": "roll_deg", "least": -5.0, "most": 5.0, "level": "warning"},
        ],
        plan=[
            {"time_s": 0.0, "position_m": [-11.6, 0.2, 0.1]},
            {"time_s": 10.0, "position_m": [-1.6, 0.2, 0.1]},
        ],
    )
    inside = watch.state(5.0, motion_of(aligned(5.0), move=(0.0, 0.0, -0.2)), COVARIANCE)
    assert inside["in_corridor"]
    assert inside["in_keep_out"]
    assert inside["alarms"] == []
    assert inside["plan_m"] == pytest.approx(0.0, abs=1e-12)
    fast = watch.state(11.0, motion_of(aligned(5.0), move=(0.0, 0.0, -0.4)), COVARIANCE)
    assert [alarm["quantity"] for alarm in fast["alarms"]] == ["range_rate_m_s"]
    assert "-0.4 m/s: less than -0.3 m/s" in fast["alarms"][0]["text"]
    assert fast["plan_m"] is None
    far = watch.state(0.0, motion_of(aligned(15.0), move=(0.0, 0.0, -0.4)), COVARIANCE)
    assert far["alarms"] == []
    beside = watch.state(0.0, motion_of(aligned(5.0, 2.0)), COVARIANCE)
    assert [alarm["quantity"] for alarm in beside["alarms"]] == ["keep_out", "corridor"]
    assert beside["plan_m"] == pytest.approx(math.hypot(5.0, 2.0))
    turned = aligned(5.0)
    spun = Rotation.from_rotvec([0.0, 0.0, 0.2]).as_matrix()
    rolled = Pose(spun @ turned.rotation, spun @ turned.translation_m)
    alarms = watch.state(0.0, motion_of(rolled), COVARIANCE)["alarms"]
    assert [alarm["level"] for alarm in alarms] == ["warning"]


def test_without_a_port_range_and_bearing_are_of_the_view_centre():
    watch = ApproachMonitor(None, None, np.array([0.0, 0.0, 1.0]))
    state = watch.state(0.0, motion_of(Pose(np.eye(3), np.array([0.0, 0.0, 8.0]))), COVARIANCE)
    assert state["range_m"] == pytest.approx(9.0)
    assert state["along_m"] is None
    assert state["roll_rad"] is None
    assert state["alarms"] == []
    Approach.model_validate(state)


def test_the_docking_ring_is_the_port_where_none_is_named():
    ring = FusionRequest.model_validate(
        {"ring": {"centre_m": PORT["centre_m"], "axis": PORT["axis"], "radius_m": 0.5}}
    )
    watch = ApproachMonitor(None, ring, np.zeros(3))
    assert watch.state(0.0, motion_of(aligned(5.0)), COVARIANCE)["along_m"] == pytest.approx(5.0)


def test_nothing_is_said_without_a_pose():
    lost = {"pose": None, "rates": None, "status": "lost", "reason": "far"}
    assert monitor().state(0.0, lost, None) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"port": PORT | {"axis": [0.0, 0.0, 0.0]}},
        {"limits": [{"quantity": "range_m"}]},
        {"limits": [{"quantity": "speed", "most": 1.0}]},
        {"corridor": {"half_angle_deg": 90.0, "length_m": 1.0}},
        {"plan": [{"time_s": 1.0, "position_m": [0, 0, 0]}] * 2},
        {"more": 1},
    ],
)
def test_impossible_requests_are_refused(wrong):
    with pytest.raises(ValidationError):
        ApproachRequest.model_validate(wrong)


def test_what_needs_a_port_says_so():
    asked = ApproachRequest.model_validate({"corridor": {"half_angle_deg": 5.0, "length_m": 9.0}})
    with pytest.raises(RendezviewError, match="need a port"):
        ApproachMonitor(asked, None, np.zeros(3))
    parallel = ApproachRequest.model_validate({"port": PORT | {"up": [1.0, 0.0, 0.0]}})
    with pytest.raises(RendezviewError, match="parallel"):
        ApproachMonitor(parallel, None, np.zeros(3))
