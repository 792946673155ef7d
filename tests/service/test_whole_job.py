"""An approach to the client's ring over HTTP: frames and ranges in, all the rest out."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from tests.service import approach
from tests.waiting import wait_until

from rendezview.io.bundled import find_target
from rendezview.io.results import read_json_lines
from rendezview.io.sequences import open_sequence
from rendezview_service.client import ServiceError, fused_pose_of_state, pose_of_state
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.messages import SessionInfo, State


@pytest.fixture(scope="module")
def served(flown, start_service, tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    target = find_target("client").mesh_path.parent
    service = start_service(
        str(flown / "client.rvm"), "--target", str(target), "--record", str(logs), given=False
    )
    service.folder = logs
    yield service
    service.stop()


def frames_of(flown: Path):
    """Time, picture, echo and true pose of each frame."""
    echoes = read_json_lines(flown / "laser.jsonl")
    for frame, echo in zip(open_sequence(flown / "scene"), echoes, strict=True):
        yield frame.time_s, frame.read(), echo, frame.camera_from_target


def _tracked(session, image, time_s):
    """The state of a frame, or None while no worker is ready."""
    with contextlib.suppress(ServiceError):
        return session.track(image, time_s)
    return None


def open_session(client, flown: Path, **more):
    first = open_sequence(flown / "scene").frames[0]
    return client.open(first.camera, prior=first.camera_from_target, **more)


def test_frames_and_ranges_alone_give_what_the_commands_give(served, flown):
    """The log repeats it bit for bit."""
    model = flown / "client.rvm"
    outcome = approach.Outcome()
    with served.client() as client:
        session = open_session(client, flown, name="whole")
        for time_s, image, echo, _ in frames_of(flown):
            session.measure("laser", echo)
            state = session.track(image, time_s)
            State.model_validate(state)
            approach.note(outcome, state)
        told = SessionInfo.model_validate(session.info())
        log_name = told.recording.name
        session.close()
    assert told.on_frames.ring
    health = {sensor.name: sensor for sensor in told.sensors}
    assert list(health) == ["camera", "laser", "ring"]
    assert health["ring"].frames == len(outcome.tracked)
    assert health["ring"].trust.heard >= 3
    commands = approach.by_commands(flown, model)
    for name, (ours, theirs, apart) in approach.compare(commands, outcome).items():
        assert ours == theirs, name
        assert apart < 1e-6, name
        assert ours > 0 or name.startswith("open"), name

    log = read_log(served.folder / log_name)
    *_, (_, so_far) = repeat(log, model_of(log, None))
    assert (so_far.frames, so_far.differing, so_far.gap) == (len(outcome.tracked), 0, None)
    with open(served.folder / log_name, "rb") as file:
        kept = [
            json.loads(message.data)
            for *_, message in make_reader(file).iter_messages(topics=["/rendezview/state"])
        ]
    assert [state["ring"] for state in kept] == list(outcome.rings.values())
    assert [state["trajectory"] for state in kept] == list(outcome.paths.values())


def test_near_the_ring_a_session_outlives_its_worker(served, flown):
    """The fused state is handed over, and rings keep it, with or without poses of the camera."""
    with served.client() as client:
        session = open_session(client, flown, name="moved")
        states, errors_m = [], []
        ring = find_target("client").docking_ring
        for time_s, image, echo, truth in frames_of(flown):
            near = np.linalg.norm(truth.apply(ring.centre_m)) < 4.5
            if near and not errors_m:
                os.kill(served.workers[0], signal.SIGKILL)
            if not near:
                session.measure("laser", echo)
            state = wait_until(lambda: _tracked(session, image, time_s))  # noqa: B023  at once
            states.append(state)
            if near:
                given = [fused_pose_of_state(state)]
                if state["pose"] is not None:
                    given.append(pose_of_state(state))
                true_m = truth.apply(ring.centre_m)
                errors_m.append(max(np.linalg.norm(p.apply(ring.centre_m) - true_m) for p in given))
        assert len(errors_m) >= 3
        assert max(errors_m) < 0.03
        for state in states[-len(errors_m) :]:
            assert state["fused"]["status"] == "tracking"
            assert state["ring"]["verdict"]["accepted"]
        log_name = session.info()["recording"]["name"]
        session.close()
    first = log_name.replace("-2.mcap", ".mcap")
    assert first != log_name
    log = read_log(served.folder / first)
    *_, (_, so_far) = repeat(log, model_of(log, None))
    assert (so_far.frames, so_far.differing, so_far.gap) == (len(states), 0, None)
