"""The service on a Ray cluster: another node or gateway goes on, nothing is lost."""

from __future__ import annotations

import contextlib
import shutil
import struct
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.service.logged import states_of
from tests.service.ray_nodes import Gateway, Nodes, slots_of, wait_for
from tests.waiting import MOST_S, wait_until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from rendezview.errors import RendezviewError
from rendezview_service.client import Client
from rendezview_service.client.messages import ServiceError
from rendezview_service.logs.log_repair import mend

pytest.importorskip("ray", reason="needs ray: pip install 'rendezview[ray]'")

_SENDER = "the only one"


class Cluster:
    """Two nodes and two gateways on this machine."""

    def __init__(self, work: Path, model: Path) -> None:
        self.work = work
        for name in ("open", "models", "logs"):
            (work / name).mkdir()
        shutil.copy(model, work / "models" / "bumpy.rvm")
        self.nodes = Nodes(2)
        address = self.nodes.cluster.address
        self.gateways = [Gateway(address, work) for _ in range(2)]
        wait_for(self.gateways[0], 2)

    def client(self, gateway: int = 0) -> Client:
        return Client(self.gateways[gateway].url, sender=_SENDER, timeout_s=MOST_S, reconnect_s=0.0)

    def node_of(self, session: str) -> int:
        slot = next(s for s in slots_of(self.gateways[0]) if s["session"] == session)
        return [node.node_id for node in self.nodes.nodes].index(slot["node"])

    def logged(self, session: str) -> dict[int, list[dict[str, Any]]]:
        """The states in the parts of a session's log, by frame."""
        found: dict[int, list[dict[str, Any]]] = {}
        for path in self.work.glob(f"logs/{session}-*.mcap"):
            mend(path)
            for frame, state in states_of(path).items():
                found.setdefault(frame, []).append(state)
        return found


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, model_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"), model_path)
    yield made
    for gateway in made.gateways:
        gateway.kill()
    made.nodes.cluster.shutdown()


def _patient(cluster: Cluster, gateway: int, image: np.ndarray, time_s: float) -> dict[str, Any]:
    """The state of a frame that is sent until it is tracked."""

    def tracked() -> dict[str, Any] | None:
        with contextlib.suppress(RendezviewError), cluster.client(gateway) as client:
            return client.session("run").track(image, time_s)
        return None

    state = wait_until(tracked)
    assert state is not None
    return state


def _watch(watcher: ClientConnection) -> None:
    while True:
        watcher.recv(MOST_S)


def test_nodes_gateways_and_models_change_under_a_session(
    cluster, camera, tour, refining_model, tmp_path
) -> None:
    states = []
    tour = [(20.0 * time_s, pose, image) for time_s, pose, image in tour]  # slow, for the filter
    sensors = {"fusion": True, "trajectory": {"shape": "vbar"}}
    with cluster.client() as client:
        client.open(camera, name="run", prior=tour[0][1], idle_s=600.0, sensors=sensors)
        with pytest.raises(ServiceError, match="there is one already"):
            client.open(camera, name="run")
        with pytest.raises(ServiceError, match="there is none with this id"):
            client.session("other").track(tour[0][2], 0.0)
        session = client.session("run")
        states += [session.track(image, time_s) for time_s, _, image in tour[:4]]
        first_model = states[0]["model_sha256"]

        # A new file of its model: the session takes it along to the free slot.
        replace(refining_model, provenance={"why": "newer"}).save(tmp_path / "new.rvm")
        answer = httpx.put(
            f"{cluster.gateways[1].url}v1/models/bumpy?replace=true",
            content=(tmp_path / "new.rvm").read_bytes(),
            timeout=MOST_S,
        )
        assert answer.status_code == 201, answer.text
        assert session.track(tour[4][2], tour[4][0])["model_sha256"] == first_model
        before = cluster.node_of("run")
        assert client.request("POST", "/v1/models/bumpy/roll") == {"moved": 1}
        assert cluster.node_of("run") != before
        states.append(session.track(tour[5][2], tour[5][0]))
        assert states[3]["fused"]["status"] == "tracking"
        assert states[-1]["fused"]["status"] == "tracking"  # the filter went along
        assert states[-1]["trajectory"]["number"] == 0
        assert states[-1]["model_sha256"] == answer.json()["sha256"] != first_model

    # The other gateway knows nothing of it yet, and answers; a watcher and a stream too.
    url = cluster.gateways[1].url.replace("http", "ws") + "v1/sessions/run"
    with connect(f"{url}/watch?contour=true") as watcher:
        states.append(_patient(cluster, 1, tour[6][2], tour[6][0]))
        assert f'"frame":{states[-1]["frame"]}' in str(watcher.recv(MOST_S))
    with connect(f"{url}/stream", additional_headers={"X-Sender": _SENDER}) as stream:
        stream.send(struct.pack("<d", tour[7][0]) + tour[7][2].tobytes())
        assert '"status":"ok"' in str(stream.recv(MOST_S))

    # kill -9 of its node, while a frame is sent.
    wait_for(cluster.gateways[0], 2)
    place = cluster.node_of("run")
    ended = threading.Thread(target=cluster.nodes.kill_only, args=(place,))
    with connect(f"{url}/watch") as watcher:
        ended.start()
        states += [_patient(cluster, 0, image, time_s) for time_s, _, image in tour[8:12]]
        with pytest.raises(ConnectionClosed):
            _watch(watcher)
        assert watcher.close_code == 1012  # open it again
    ended.join(MOST_S)
    place, before = cluster.node_of("run"), place
    assert place != before

    # kill -9 of the orchestrator: the session stays where it is, and gets no second slot.
    cluster.nodes.kill_orchestrator()
    health = httpx.get(cluster.gateways[0].url + "healthz", timeout=MOST_S)
    assert (health.status_code, health.json()["status"]) == (200, "not ready")

    def is_ready() -> bool:
        ready = httpx.get(cluster.gateways[0].url + "readyz", timeout=MOST_S).status_code == 200
        if not ready:
            states.append(_patient(cluster, 0, tour[12][2], tour[12][0] + 0.001 * len(states)))
        return ready

    wait_until(is_ready)
    assert cluster.node_of("run") == place

    cluster.gateways[0].kill()
    states += [_patient(cluster, 1, image, time_s) for time_s, _, image in tour[13:17]]

    # The disk of the checkpoints fails: tracking goes on, and the reason is there until it works.
    def health() -> dict[str, Any]:
        return httpx.get(cluster.gateways[1].url + "readyz", timeout=MOST_S).json()

    (cluster.work / "open").rename(cluster.work / "away")
    states.append(_patient(cluster, 1, tour[17][2], tour[17][0]))
    wait_until(lambda: health()["status"] == "degraded")
    assert "session run cannot go on elsewhere" in health()["reasons"][0]
    (cluster.work / "away").rename(cluster.work / "open")
    states.append(_patient(cluster, 1, tour[18][2], tour[18][0]))
    wait_until(lambda: health()["status"] == "ok")

    frames = [state["frame"] for state in states]
    assert frames == sorted(set(frames))
    assert all(state["recorded"] and state["pose"] is not None for state in states)
    with cluster.client(1) as client:
        kinds = [
            event["kind"] for event in client.request("GET", "/v1/sessions/run/events")["events"]
        ]
        assert "node" in kinds
        assert [one["id"] for one in client.sessions()] == ["run"]
        assert client.session("run").info()["found_fraction"] == 1.0  # of all nodes
        client.request("DELETE", "/v1/sessions/run")
    wait_until(lambda: not list(cluster.work.glob("open/*")))
    logged = cluster.logged("run")
    assert all(state in logged[state["frame"]] for state in states)
