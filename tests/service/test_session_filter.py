"""The filter of a session, without a service."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.service.sensors import Sensors, observed, plain

from rendezview.geometry.pose import Pose
from rendezview.sensors.beam import BeamMesh
from rendezview.sensors.observation import Observation, Status
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.messages.messages import ObservationMessage, State
from rendezview_service.tracker.sensor_lines import split_records
from rendezview_service.tracker.session_filter import SessionFilter


def test_a_state_has_the_keys_of_every_sensors_record():
    record = Observation(Status.OK).record()
    assert set(ObservationMessage.model_fields) == set(record)
    assert set(record) < set(State.model_fields)


def test_the_filter_begins_anew_where_the_cameras_clock_jumps(tour):
    truth = tour[0][1]
    one = SessionFilter(FusionRequest())
    sensors = Sensors()
    for k in range(5):
        text = json.dumps(sensors.pose(float(k), truth)).encode()
        (line,) = one.check("mirrors", text, float(k))
        one.take("mirrors", line)
        state = one.track(observed(float(k), truth))
    assert state["status"] == "tracking"
    state = one.track(observed(1e6, truth))
    assert state["status"] == "starting"
    assert "camera's time" in state["reason"]
    assert state["pose"]["translation_m"] == pytest.approx(truth.translation_m)
    for k in range(1, 3):
        state = one.track(observed(1e6 + k, truth))
    assert (state["status"], state["reason"]) == ("tracking", None)


def test_a_sensor_mounted_elsewhere_is_taken_into_the_camera_frame(tour):
    truth = tour[0][1]
    mount = Pose(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), [0.5, 0.1, -0.2])
    fusion = plain({"mounts": {"side": mount}})
    one = SessionFilter(FusionRequest.model_validate(fusion))
    record = Sensors().pose(0.0, mount @ truth)
    (line,) = one.check("side", json.dumps(record).encode(), 0.0)
    assert line.marks is None  # its pixels are not the camera's
    _, state = one.take("side", line)
    assert state["pose"]["translation_m"] == pytest.approx(truth.translation_m, abs=0.2)


def test_a_message_is_one_object_or_one_a_line():
    assert split_records(b'{"a": 1}\n\n{"b": 2}\n') == [{"a": 1}, {"b": 2}]
    assert split_records(b'{\n "a": {\n  "b": 1\n }\n}') == [{"a": {"b": 1}}]
    assert split_records('{"a": "\u2028"}'.encode()) == [{"a": "\u2028"}]


def test_a_rangers_beam_is_cast_on_the_mesh_of_the_model(tour):
    truth = tour[0][1]
    inverse = truth.inverse()
    spot = inverse.apply(np.array([0.0, 0.0, 20.0]))  # of a beam along the boresight
    sides = np.linalg.svd((inverse.rotation @ [0.0, 0.0, 1.0])[None])[2][1:]  # across it
    corners = spot + 40.0 * np.array([sides[0], sides[1], -sides[0] - sides[1]])
    one = SessionFilter(FusionRequest(), mesh=BeamMesh(corners, np.array([[0, 1, 2]])))
    for k in range(5):
        one.track(observed(float(k), truth))
    line = json.dumps({"time_s": 4.5, "range_m": 20.01, "sigma_m": 0.01}).encode()
    (read,) = one.check("laser", line, 4.5)
    verdict, state = one.take("laser", read)
    assert (verdict["accepted"], verdict["reason"]) == (True, None)
    assert state["pose"]["translation_m"][2] - truth.translation_m[2] == pytest.approx(
        0.01, abs=5e-3
    )
