"""The filter of a session with a camera only, without a service."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.sensors.observation import Observation, Status
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.tracker.session_filter import SessionFilter

WHITE = np.sqrt(0.1)
SIGMA = np.array([4e-4] * 3 + [1e-3, 1e-3, 3e-3])


def run(count: int, step_s: float, turn_rad, move_m, seed: int = 0, turns_at: int = 10**6):
    """States of a filter on noisy poses; the motion turns back after some of them.

    Most of the error lasts, as that of a camera does (docs/fusion.md); a tenth of its variance is
    new with each frame.
    """
    rng = np.random.default_rng(seed)
    lasting = rng.normal(size=6) * SIGMA
    one = SessionFilter(None)
    states, turned, place = [], np.zeros(3), np.array([0.0, 0.0, 9.0])
    for k in range(count):
        way = 1.0 if k < turns_at else -1.0
        rotation = Rotation.from_rotvec(turned).as_matrix()
        pose = Pose(rotation, place).perturbed(lasting + rng.normal(size=6) * WHITE * SIGMA)
        seen = Observation(Status.OK, time_s=k * step_s, pose=pose, covariance=np.diag(SIGMA**2))
        states.append(one.track(seen))
        turned = turned + way * np.asarray(turn_rad)
        place = place + way * np.asarray(move_m)
    return one, states


@pytest.mark.parametrize("step_s", [0.03, 0.1, 1.0, 5.0])
def test_rates_are_found_at_any_frame_rate_and_turn(step_s):
    turn, move = np.deg2rad([1.2, 0.0, 0.0]), np.array([0.01, -0.02, 0.03])
    _, states = run(24, step_s, turn, move)
    last = states[-1]
    assert last["status"] == "tracking"
    assert last["starts"] == 1
    sigma = np.sqrt(np.diag(last["covariance"]))[6:]
    found = np.r_[last["rates"]["angular_rad_s"], last["rates"]["linear_m_s"]]
    wanted = np.r_[turn, move] / step_s
    assert np.all(np.abs(found - wanted) < 4.0 * sigma)


def test_a_motion_that_turns_back_is_followed_after_three_poses():
    turn, move = np.deg2rad([3.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.1])
    _, states = run(40, 1.0, turn, move, turns_at=20)
    assert states[19]["status"] == "tracking"
    turned_m = states[20]["pose"]["translation_m"][2]
    for k in range(23, 40):
        assert states[k]["pose"]["translation_m"][2] == pytest.approx(
            turned_m - 0.1 * (k - 20), abs=0.03
        )
    last = states[-1]
    assert last["status"] == "tracking"
    assert last["rates"]["linear_m_s"][2] == pytest.approx(-0.1, abs=0.01)


def test_options_of_the_session_are_kept():
    asked = FusionRequest.model_validate({"options": {"motion": {"first_rate": 0.001}}})
    one = SessionFilter(asked)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 9.0]))
    seen = Observation(Status.OK, time_s=0.0, pose=pose, covariance=np.diag(SIGMA**2))
    state = one.track(seen)
    assert np.sqrt(state["covariance"][6][6]) == pytest.approx(0.001, rel=1e-6)
