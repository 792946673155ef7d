"""Health, metrics, models, trainings, sources, and life after a worker's death."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest
import trimesh
from tests.waiting import MOST_S, wait_until

from rendezview.cli.main import main
from rendezview.errors import RendezviewError
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_service.client import ServiceError
from rendezview_service.hub.service import Service
from rendezview_service.logs.log_repair import mend
from rendezview_service.logs.replay import model_of, read_log, repeat
from rendezview_service.messages.model_messages import JobInfo, ModelInfo
from rendezview_service.settings import Settings


def test_the_service_says_that_it_lives_and_is_ready(service):
    for path in ("healthz", "readyz"):
        answer = httpx.get(service.url + path, timeout=MOST_S)
        assert answer.status_code == 200
        assert answer.json()["status"] == "ok"


def test_metrics_count_frames_and_forget_sessions(service, client, camera, tour):
    session = client.open(camera, name="counted")
    for time_s, _, image in tour[:3]:
        session.track(image, time_s)
    text = httpx.get(service.url + "metrics", timeout=MOST_S).text
    counted = [line for line in text.splitlines() if line.startswith("rendezview_frames_total{")]
    assert sum(float(line.split()[-1]) for line in counted if '"counted"' in line) == 3.0
    assert 'rendezview_latency_seconds_count{session="counted"} 3.0' in text
    session.close()
    assert '"counted"' not in httpx.get(service.url + "metrics", timeout=MOST_S).text


def test_openapi_names_every_route(service):
    paths = httpx.get(service.url + "openapi.json", timeout=MOST_S).json()["paths"]
    assert "post" in paths["/v1/sessions/{name}/frames"]
    assert {"/v1/models/{name}", "/v1/jobs", "/healthz", "/metrics"} <= set(paths)


def test_faults_have_one_form(service):
    for method, path, status in [
        ("GET", "v1/nothing", 404),
        ("PATCH", "v1/sessions", 405),
        ("GET", "v1/sessions/nobody", 404),
        ("GET", "v1/models/..%2f..%2fetc%2fpasswd", 404),
        ("GET", "v1/sessions/nobody/history?seconds=-1", 404),
        ("POST", "v1/jobs?model=a", 422),
        ("POST", "v1/sessions", 422),
        ("GET", "..%2f..%2fetc/passwd", 404),
        ("GET", "%2e%2e/settings.py", 404),
    ]:
        answer = httpx.request(method, service.url + path, timeout=MOST_S)
        assert answer.status_code == status, path
        assert answer.json()["status"] == status
        assert answer.json()["error"]


def test_models_are_sent_checked_used_and_deleted(service, client, model_path, camera):
    ModelInfo.model_validate(client.send_model("sent", model_path))
    with pytest.raises(ServiceError, match="there is one already") as refused:
        client.send_model("sent", model_path)
    assert refused.value.status == 409
    session = client.open(camera, model="sent")
    with pytest.raises(ServiceError, match="a session uses it"):
        client.request("DELETE", "/v1/models/sent")
    session.close()
    client.request("DELETE", "/v1/models/sent")
    with pytest.raises(ServiceError, match="stays"):
        client.request("DELETE", "/v1/models/bumpy")
    whole = model_path.read_bytes()
    for name, content in [
        ("cut", whole[:-1000]),
        ("turned", whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:]),
        ("pickled", b"\x80\x04\x95" + bytes(100)),
        ("empty", b""),
        ("..%2fup", whole),
        (".hidden", whole),
    ]:
        with pytest.raises(ServiceError) as refused:
            client.request("PUT", f"/v1/models/{name}", content, "application/octet-stream")
        assert refused.value.status in (404, 405, 422), name
    assert [m["name"] for m in client.request("GET", "/v1/models")["models"]] == ["bumpy"]


def test_without_a_model_given_the_stored_ones_warm_it_up(
    start_service, model_path, camera, tour, tmp_path
):
    (tmp_path / "a-broken.rvm").write_bytes(b"junk")
    (tmp_path / "stored.rvm").write_bytes(model_path.read_bytes())
    served = start_service("--models", str(tmp_path), given=False)
    assert any("a-broken" in line and "not read" in line for line in served.lines)
    with served.client() as client:
        broken, stored = client.request("GET", "/v1/models")["models"]
        assert (broken["name"], broken["sha256"]) == ("a-broken", None)
        assert "a-broken.rvm" in broken["error"]
        assert stored["error"] is None
        session = client.open(camera, model="stored")
        time_s, _, image = tour[0]
        assert session.track(image, time_s)["pose"] is not None
        session.close()
        # A worker that dies after that model was deleted is replaced all the same.
        client.request("DELETE", "/v1/models/stored")
        (worker,) = served.workers
        os.kill(worker, signal.SIGKILL)
        content = model_path.read_bytes()
        answer = httpx.put(served.url + "v1/models/again", content=content, timeout=MOST_S)
        assert answer.status_code < 300, answer.text
        session = wait_until(lambda: _opened(client, camera, model="again"))
        assert session.track(image, time_s)["pose"] is not None
    served.stop()


def _opened(client, camera, **more):
    """A session, or None while no worker is ready for it."""
    with contextlib.suppress(ServiceError):
        return client.open(camera, **more)
    return None


def _ends_in_order(served, sent, log, states):
    """A signal to the whole group, as a terminal and some supervisors send it: the workers, which
    must not follow it, complete their logs."""
    os.killpg(served.process.pid, sent)
    assert served.process.wait(MOST_S) == 0
    assert mend(log) is None  # it is whole already
    assert [frame.state for frame in read_log(log).frames()] == states


def test_a_hung_worker_with_three_sessions_does_not_delay_the_end(start_service, camera, tour):
    served = start_service()
    with contextlib.ExitStack() as clients, ThreadPoolExecutor() as pool:
        each = [clients.enter_context(served.client()) for _ in range(3)]
        sessions = [client.open(camera, prior=tour[0][1]) for client in each]
        for session in sessions:
            session.track(tour[0][2], tour[0][0])
        (worker,) = served.workers
        os.kill(worker, signal.SIGSTOP)
        answers = [pool.submit(s.track, tour[1][2], tour[1][0]) for s in sessions]
        start_s = time.monotonic()
        served.process.send_signal(signal.SIGTERM)
        assert served.process.wait(MOST_S) == 0
        assert time.monotonic() - start_s < 20.0  # 9 s on a quiet machine; one after the other: 100
        assert all(isinstance(answer.exception(), RendezviewError) for answer in answers)


def test_it_says_that_it_serves_and_the_first_model_that_is_sent_warms_it_up(
    start_service, model_path, camera, tour, tmp_path
):
    never = {"RENDEZVIEW_SERVE_IDLE_S": "inf"}  # its workers read that, too
    # It returns with that line.
    served = start_service("--record", str(tmp_path), given=False, **never)
    assert httpx.get(served.url + "readyz", timeout=MOST_S).status_code == 200
    starts = next(k for k, line in enumerate(served.lines) if "its page is at" in line)
    assert served.url in served.lines[starts]
    assert starts < next(k for k, line in enumerate(served.lines) if "serves at" in line)
    with served.client() as client:
        with pytest.raises(ServiceError, match="there are: none"):
            client.open(camera)
        content = model_path.read_bytes()
        answer = httpx.put(served.url + "v1/models/sent", content=content, timeout=MOST_S)
        assert answer.status_code < 300, answer.text
        # On a machine that has compiled nothing yet the first tries are turned away.
        session = wait_until(lambda: _opened(client, camera))
        states = [session.track(image, time_s) for time_s, _, image in tour[:3]]
        assert states[0]["pose"] is not None
    (log,) = tmp_path.glob("*.mcap")
    _ends_in_order(served, signal.SIGINT, log, states)


def test_a_training_runs_beside_and_its_model_tracks(client, camera, tmp_path):
    mesh = tmp_path / "block.stl"
    trimesh.creation.box((2.0, 1.0, 0.6)).export(mesh)
    long = client.train("never", mesh, order=2, views=100_000)
    other = client.train("nor-this", mesh, order=2, views=100_000)
    assert other["state"] == "queued"
    for job in (other, long):
        assert client.request("DELETE", f"/v1/jobs/{job['id']}")["state"] == "cancelled"
    job = client.train("block", mesh, order=0, views=100, held_out=10)
    JobInfo.model_validate(job)
    now = _ended(client, job)
    assert now["state"] == "done", now["reason"]
    assert now["stage"] is not None
    assert now["progress"] == 1.0  # as it told when it ended
    session = client.open(camera, model="block")
    black = np.zeros((camera.height, camera.width), np.uint8)
    assert session.track(black, 0.0)["status"] == "empty"
    session.close()
    client.request("DELETE", "/v1/models/block")


def test_a_training_into_a_full_folder_leaves_no_half_model(
    service, client, models_folder, tmp_path
):
    mesh, pid = tmp_path / "block.stl", service.process.pid
    trimesh.creation.box((2.0, 1.0, 0.6)).export(mesh)
    job = client.train("full", mesh, order=0, views=100, held_out=10)
    wait_until(lambda: client.job(job["id"])["stage"])  # a process of its own
    unlimited = (resource.RLIM_INFINITY,) * 2
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
    try:
        now = _ended(client, job)
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
    assert now["state"] == "failed"
    assert "cannot be written" in now["reason"]
    assert not [path for path in models_folder.iterdir() if "full" in path.name]


def _ended(client, job):
    """A training that is over."""

    def over():
        now = client.job(job["id"])
        return None if now["state"] in ("queued", "running") else now

    return wait_until(over)


def test_trainings_that_cannot_be_are_refused(client, tmp_path):
    bad = tmp_path / "bad.stl"
    bad.write_bytes(b"this is no mesh")
    job = client.train("bad", bad)
    now = _ended(client, job)
    assert now["state"] == "failed"
    assert now["reason"]
    assert str(tmp_path) not in now["reason"]
    for query, said in [
        ("model=a&file=x.py", "no mesh"),
        ("model=bumpy&file=x.stl", "there is one already"),
        ("model=..%2fa&file=x.stl", "model"),
        ("model=a&file=x.stl&unit=parsec", "unit"),
    ]:
        with pytest.raises(ServiceError, match=said):
            client.request("POST", f"/v1/jobs?{query}", b"solid", "application/octet-stream")


def test_a_source_is_tracked_to_its_last_frame(start_service, camera, tour, tmp_path):
    scene = tmp_path / "scene"
    with BopSceneWriter(scene, camera) as writer:
        for k, (time_s, pose, image) in enumerate(tour[:8]):
            writer.add(k, image, pose, time_s)
    place = tmp_path / "run.mcap"
    served = start_service("--source", str(scene), "--record", str(place), "--speed", "0")
    with served.client() as client:
        wait_until(lambda: client.session("main").info()["finished"])
        info = client.session("main").info()
    assert (info["frames"], info["drops"], info["reason"]) == (8, 0, None)
    served.stop()
    assert served.process.returncode == 0
    log = read_log(place)
    *_, (_, so_far) = repeat(log, model_of(log, None))
    assert (so_far.frames, so_far.differing, so_far.gap) == (8, 0, None)


@pytest.mark.requirement("RV-SVC-1")
def test_the_service_outlives_all_its_workers(start_service, camera, tour, tmp_path):
    """The one that tracks and the spare one at once."""
    served = start_service("--record", str(tmp_path), RENDEZVIEW_SERVE_SPARE_WORKER="true")
    with served.client() as client:
        session = client.open(camera, prior=tour[0][1])
        before = [session.track(image, time_s) for time_s, _, image in tour[:3]]
        served.await_line("a spare worker is ready")
        workers = served.workers
        assert len(workers) == 2
        for worker in workers:
            os.kill(worker, signal.SIGKILL)

        def tracked():
            try:
                return session.track(tour[3][2], tour[3][0])
            except ServiceError as error:
                if error.status != 503:
                    raise
                return None

        after = wait_until(tracked)
        assert after["frame"] == len(before)
        assert after["status"] == "ok"
        assert "rendezview_worker_restarts_total 2.0" in client.fetch("GET", "/metrics").decode()
    first, second = sorted(tmp_path.glob("*.mcap"), key=lambda log: log.stat().st_mtime)
    assert [frame.state for frame in read_log(first).frames()] == [*before, after]
    _ends_in_order(served, signal.SIGTERM, second, [after])


def test_a_full_disk_is_seen_by_the_operator_and_tracking_goes_on(service, client, camera, tour):
    session = client.open(camera, prior=tour[0][1], name="full")
    times_s = itertools.count()

    def track():
        return session.track(tour[0][2], float(next(times_s)))

    assert track()["recorded"]
    assert "rendezview_faults 0.0" in client.fetch("GET", "/metrics").decode()
    with service.full_disk():
        states = [track() for _ in range(3)]
        assert [state["recorded"] for state in states] == [False] * 3
        assert "pending: " in states[0]["record"]
        assert {state["status"] for state in states} == {"ok"}
        recording = session.info()["recording"]
        assert (recording["state"], recording["pending"]) == ("failed", 3)
        assert "cannot be written" in recording["reason"]
        metrics = client.fetch("GET", "/metrics").decode()
        assert 'rendezview_log_failed{session="full"} 1.0' in metrics
        assert "rendezview_faults 1.0" in metrics
        assert 'rendezview_log_pending_states{session="full"} 3.0' in metrics
        health = client.request("GET", "/healthz")
        assert (health["status"], health["recording_failures"]) == ("degraded", 1)
        (reason,) = health["reasons"]
        assert "session full is not recorded" in reason
    wait_until(lambda: track()["recorded"])  # a new file is tried every few seconds
    info = session.info()["recording"]
    assert (info["state"], info["lost"]) == ("on", 0)
    assert info["name"].endswith("-2.mcap")
    assert service.states_reported("full", last="on", message="recording") == ["failed", "on"]
    session.close()


@pytest.mark.parametrize(
    ("model", "settings", "sources", "said"),
    [
        ("nothing.rvm", {}, [], "no such model file"),
        (None, {"camera": Path("nothing.yaml")}, [], "no such file"),
        (None, {}, ["nothing"], "no such file"),
        (None, {}, ["/dev/video99"], "--camera"),
        (None, {}, ["rtsp://nobody.example/1"], "--camera"),
    ],
)
def test_a_service_that_cannot_be_is_refused(model_path, model, settings, sources, said):
    with pytest.raises(RendezviewError, match=said):
        Service(Settings(**settings), Path(model) if model else model_path, sources)


def test_commands_say_what_is_wrong_in_one_line(tmp_path, model_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for arguments, said in [
        (["serve", model_path, "--host", "0.0.0.0"], "--tokens"),
        (["replay", model_path], "not an MCAP"),
    ]:
        monkeypatch.setattr(sys, "argv", ["rendezview", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        told = capsys.readouterr().err
        assert ended.value.code == 1, arguments
        assert said in told
        assert len(told.strip().splitlines()) == 1


def test_the_log_of_the_service_is_json_lines(service, client, camera):
    client.open(camera, name="logged").close()
    assert service.states_reported("logged", last="closed") == ["opened", "closed"]
