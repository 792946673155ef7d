"""The live streams for Foxglove and Rerun carry what the service found."""

from __future__ import annotations

import itertools
import json
import socket
import subprocess
import tempfile

import pytest
from tests.left_behind import none_left_behind
from tests.service.foxglove import FoxgloveViewer
from tests.waiting import MOST_S, free_port, wait_until
from websockets.sync.client import connect

from rendezview.errors import RendezviewError
from rendezview_service.hub import viewers
from rendezview_service.settings import Settings

_FUSED = {"fusion": True}  # the filter runs from the first frame on


def test_foxglove_receives_poses_pictures_and_states(watched, camera, tour) -> None:
    with (
        watched.served.client() as client,
        client.open(camera, name="live", prior=tour[0][1], sensors=_FUSED) as session,
        connect(f"ws://127.0.0.1:{watched.foxglove}", subprotocols=["foxglove.sdk.v1"]) as stream,
    ):
        viewer = FoxgloveViewer(stream)
        wanted = {"/live/state", "/live/target/pose", "/live/tf", "/live/camera/image",
                  "/live/camera/contour", "/live/target/fused"}  # fmt: skip
        frames = itertools.count()

        def all_seen() -> bool:
            k = next(frames)
            # The last picture again and again: a viewer may subscribe after all others were sent.
            picture, later_s = tour[min(k, len(tour) - 1)], max(0, k - len(tour) + 1)
            session.track(picture[2], picture[0] + later_s)
            viewer.listen(0.2)
            return set(viewer.seen) >= wanted

        wait_until(all_seen, lambda: (viewer.channels, list(viewer.seen)))
    assert json.loads(viewer.seen["/live/state"])["session"] == "live"
    assert b"\xff\xd8\xff" in viewer.seen["/live/camera/image"]


def test_rerun_receives_a_stream(watched, camera, tour) -> None:
    served, port = watched.served, watched.rerun
    with (
        served.client() as client,
        client.open(camera, name="live", prior=tour[0][1], sensors=_FUSED) as session,
    ):
        for time_s, _, image in tour[:4]:
            state = session.track(image, time_s)
            assert state["pose"] is not None
        assert state["fused"]["pose"] is not None  # is drawn too
        with socket.create_connection(("127.0.0.1", port), MOST_S) as peer:  # it speaks HTTP/2
            peer.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0]))
            assert peer.recv(9)[3] == 4  # a SETTINGS frame
        # Without tokens: this machine's other addresses do not reach it.
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port), MOST_S)
    assert not [line for line in served.lines if "live stream failed" in line]


def test_what_a_rerun_viewer_starts_ends_with_it() -> None:
    """The package's own command would start the server as a child, and leave it behind."""
    pytest.importorskip("rerun")
    with none_left_behind(5.0):
        live = viewers.Viewers(Settings(rerun_port=free_port()))
        live.start()
        live.close()


def test_a_rerun_program_that_does_not_start_leaves_nothing(tmp_path, monkeypatch) -> None:
    pytest.importorskip("rerun")
    started: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen):
        def __init__(self, command, **options) -> None:
            # Its first run writes its settings, its second is the server, which has no time.
            if started:
                command = ["sleep", "600"]
                monkeypatch.setattr(viewers, "_SERVER_START_S", 0.1)
            super().__init__(command, **options)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(RendezviewError, match="does not listen on"):
        viewers.Viewers(Settings(rerun_port=free_port())).start()
    assert len(started) == 2
    assert all(program.poll() is not None for program in started)
    assert list(tmp_path.iterdir()) == []


def test_a_taken_port_of_rerun_is_reported(tmp_path, monkeypatch) -> None:
    pytest.importorskip("rerun")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = viewers.Viewers(Settings(rerun_port=other.getsockname()[1]))
        with pytest.raises(RendezviewError, match="in use"):
            taken.start()
    assert list(tmp_path.iterdir()) == []
