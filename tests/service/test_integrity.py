"""Protection levels of a session's poses."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from tests.conftest import Draw

from rendezview.geometry import so3
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.mesh.mesh import Mesh
from rendezview_service.messages.message_parts import PoseMessage
from rendezview_service.messages.messages import IntegrityRequest, SessionRequest, State
from rendezview_service.tracker.tracking import SessionTracker, camera_message


@pytest.mark.parametrize("asked", [None, IntegrityRequest(alarm_attitude_rad=1e-6)])
def test_a_state_has_the_levels_that_the_session_asked_for(
    asked: IntegrityRequest | None,
    refining_model: ViewModel,
    bumpy_mesh: Mesh,
    camera: Camera,
    draw: Draw,
):
    pose = Pose(so3.exp(np.array([0.4, 0.7, -0.3])), np.array([0.1, 0.0, 6.0]))
    request = SessionRequest(
        camera=camera_message(camera), prior=PoseMessage(**pose.as_dict()), integrity=asked
    )
    tracker = SessionTracker("one", refining_model, request)
    frame = draw(bumpy_mesh, pose, camera, np.random.default_rng(1))
    state = State.model_validate(tracker.track(frame, 0.0, 0.0)[0])
    assert state.pose is not None
    if asked is None:
        assert state.protection is None
        return
    assert state.protection is not None
    assert state.protection.risk == 1e-3
    assert "attitude" in state.protection.alarms
    assert state.protection.alarm


@pytest.mark.parametrize("wrong", [{"risk": 0.5}, {"alarm_position_m": -1.0}, {"limit": 3}])
def test_a_wrong_request_is_refused(wrong: dict[str, float]):
    with pytest.raises(ValidationError):
        IntegrityRequest(**wrong)
