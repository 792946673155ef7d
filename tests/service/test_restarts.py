"""The service or a worker ends, and starts again: its sessions go on, unless they end workers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from tests.waiting import wait_until

from rendezview_service.client import ServiceError
from rendezview_service.hub.checkpoint import SUFFIX
from rendezview_service.logs.replay import read_log

# A decoder that ends its process, for one file; and who is barred for it is so for a moment only.
FATAL_DECODER = """
import os, sys
if "serve" in sys.orig_argv:
    import rendezview_service.hub.inputs as inputs
    inputs._BARRED_S = 0.0
if "rendezview_service.worker.worker" in sys.orig_argv:
    import rendezview_service.messages.frames as frames
    real = frames.read_frame
    def read_frame(content, camera):
        if bytes(content[:8]) == b"\\xff\\xd8\\xfffatal":
            os.abort()
        return real(content, camera)
    frames.read_frame = read_frame
"""


def _logged(folder: Path, session: str) -> list[dict]:
    first = min(folder.glob(f"{session}-*.mcap"), key=lambda path: len(path.name))
    return [frame.state for frame in read_log(first).frames()]


def test_sessions_go_on_after_a_stop_and_after_a_kill(
    start_service, camera, tour, refining_model, tmp_path
):
    """One with the model of the command line, and one with a model that only it has."""
    state, logs = tmp_path / "state", tmp_path / "logs"
    replace(refining_model, provenance={"why": "other content"}).save(tmp_path / "sent.rvm")
    flags = "--state", str(state), "--record", str(logs)
    served = start_service(*flags)
    with served.client() as client:
        client.send_model("sent", tmp_path / "sent.rvm")
        client.open(camera, name="closed").close()
        for name, model in (("one", None), ("two", "sent")):
            client.open(camera, model=model, prior=tour[0][1], name=name)
        states = {
            name: [client.session(name).track(image, time_s) for time_s, _, image in tour[:4]]
            for name in ("one", "two")
        }
    for end in ("stop", "kill"):
        getattr(served, end)()
        served = start_service(*flags)
        with served.client() as client:
            assert sorted(session["id"] for session in client.sessions()) == ["one", "two"]
            assert client.session("one").state() == states["one"][-1]
            for name, before in states.items():
                session, frames = client.session(name), tour[len(before) : len(before) + 4]
                before += [session.track(image, time_s) for time_s, _, image in frames]
                assert [state["frame"] for state in before] == [*range(len(before))]
                assert {(state["status"], state["recorded"]) for state in before} == {("ok", True)}
                assert len({state["model_sha256"] for state in before}) == 1
    with served.client() as client:
        for name in states:
            client.session(name).close()
        wait_until(lambda: not [*state.glob(f"*{SUFFIX}")])
    served.stop()
    assert {name: _logged(logs, name) for name in states} == states


def test_a_session_whose_frames_end_three_processes_is_ended_and_no_other(
    start_service, camera, tour, tmp_path
):
    """None of these frames is tried twice."""
    served = start_service(before=FATAL_DECODER)
    with served.client() as client, served.client() as other:
        session, attacker = client.open(camera, name="mine"), other.open(camera, name="theirs")
        for k in range(3):
            assert session.track(tour[k][2], float(k))["frame"] == k
            assert f"worker_restarts_total {k}.0".encode() in client.fetch("GET", "/metrics")
            with pytest.raises(ServiceError, match="process ended over it") as lost:
                attacker.track(b"\xff\xd8\xfffatal")
            assert lost.value.status == 503
        wait_until(lambda: [one["id"] for one in client.sessions()] == ["mine"])
        with pytest.raises(ServiceError, match="its frames ended the tracker's process"):
            attacker.track(tour[0][2])
        assert session.track(tour[3][2], 3.0)["frame"] == 3
        assert b"worker_restarts_total 3.0" in client.fetch("GET", "/metrics")
    served.stop()
