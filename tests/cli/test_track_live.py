"""`rendezview track MODEL CAMERA`: frames as they come, poses on the screen and in a browser."""

from __future__ import annotations

import functools
import http.client
import json
import socket
import struct
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.http_server import http_server
from tests.waiting import MOST_S, wait_until

from rendezview.cli.live_view import LiveView
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import save_camera

FRAMES = 4


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def stream(
    refining_model, bumpy_mesh, camera, draw, tmp_path_factory
) -> Iterator[tuple[str, Path, Pose]]:
    """A short video at a network address, a camera file and the pose of the target in it."""
    folder, rng = tmp_path_factory.mktemp("stream"), np.random.default_rng(6)
    rotation = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    ahead = np.array([0.0, 0.0, 3.5 * refining_model.sphere_radius_m])
    pose = Pose(rotation, ahead - rotation @ refining_model.centre_m)
    size = (camera.width, camera.height)
    video = cv2.VideoWriter(str(folder / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size)
    for _ in range(FRAMES):
        grey = draw(bumpy_mesh, pose, camera, rng)
        video.write(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    video.release()
    save_camera(camera, folder / "camera.yaml")
    with http_server(functools.partial(Quiet, directory=folder)) as port:
        yield f"http://127.0.0.1:{port}/v.avi", folder / "camera.yaml", pose


def test_poses_of_a_camera_are_lines_on_the_screen(run, refining_model, stream, tmp_path):
    address, camera_file, pose = stream
    refining_model.save(tmp_path / "m.rvm")
    film = tmp_path / "film.webm"
    asked = ("track", tmp_path / "m.rvm", address, "--camera", camera_file)
    ran = run(*asked, "--show", "--video", film)
    assert ran.code == 0
    assert cv2.VideoCapture(str(film)).get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    said = ran.err.splitlines()
    assert said[0].startswith("Watch at http://127.0.0.1:")
    assert f"{FRAMES} poses in {FRAMES} frames" in said[-1]
    lines = [json.loads(line) for line in ran.out.splitlines()]
    assert len(lines) == FRAMES
    times = [line["time_s"] for line in lines]
    assert times == sorted(times)
    for line in lines:
        place = line["pose"]["translation_m"]
        assert place == pytest.approx(pose.translation_m, abs=0.02 * pose.translation_m[2])


def test_a_log_takes_the_place_of_the_screen_and_results_are_written_if_asked(
    run, refining_model, stream, tmp_path
):
    address, camera_file, _ = stream
    refining_model.save(tmp_path / "m.rvm")
    log, poses = tmp_path / "log.jsonl", tmp_path / "poses.csv"
    ran = run(
        "track", tmp_path / "m.rvm", address, "--camera", camera_file, "--log", log, "-o", poses
    )
    assert (ran.code, ran.out) == (0, "")
    assert len(log.read_text().splitlines()) == FRAMES
    assert len(poses.read_text().splitlines()) == FRAMES + 1


def test_a_camera_wants_its_calibration_and_recorded_frames_a_file(
    run, refining_model, stream, tmp_path
):
    refining_model.save(tmp_path / "m.rvm")
    run("track", tmp_path / "m.rvm", stream[0]).says("camera file", "--camera")
    run("track", tmp_path / "m.rvm", "93").says("no such camera")
    ran = run("track", tmp_path / "m.rvm", tmp_path)
    assert ran.code == 2
    assert "-o" in ran.err


def test_a_browser_gets_the_newest_picture_and_the_end():
    pictures = [np.full((40, 60, 3), level, np.uint8) for level in (40, 200)]
    with LiveView() as view:
        host = view.address.removeprefix("http://").rstrip("/")
        page = http.client.HTTPConnection(host, timeout=MOST_S)
        page.request("GET", "/")
        assert "/pictures" in page.getresponse().read().decode()
        page.request("GET", "/other")
        assert page.getresponse().status == 404
        viewer = http.client.HTTPConnection(host, timeout=MOST_S)
        view.add(pictures[0])
        viewer.request("GET", "/pictures")
        answer = viewer.getresponse()
        assert "multipart/x-mixed-replace" in str(answer.getheader("Content-Type"))
        levels = []
        for k in range(2):
            if k:
                view.add(pictures[1])
            assert answer.readline() == b"--picture\r\n"
            assert answer.readline() == b"Content-Type: image/jpeg\r\n"
            length = int(answer.readline().split()[1])
            assert answer.readline() == b"\r\n"
            packed = np.frombuffer(answer.read(length), np.uint8)
            levels.append(int(cv2.imdecode(packed, cv2.IMREAD_COLOR).mean()))
            assert answer.readline() == b"\r\n"
        assert levels == pytest.approx([40, 200], abs=2)
        gone = http.client.HTTPConnection(host, timeout=MOST_S)
        gone.request("GET", "/pictures")
        gone.getresponse().close()
        gone.close()
        view.add(pictures[0])  # a viewer that has gone holds nothing up
    assert answer.read().startswith(b"--picture")  # and then the end
    page.close()
    viewer.close()


def test_a_viewer_that_breaks_off_leaves_nothing_on_the_screen(capsys):
    before = threading.active_count()
    with LiveView() as view:
        host = ("127.0.0.1", int(view.address.rsplit(":", 1)[1].rstrip("/")))
        view.add(np.zeros((480, 640, 3), np.uint8))
        for asked in (b"GET / HT", b"GET /pictures HTTP/1.0\r\n\r\n"):
            viewer = socket.create_connection(host, timeout=MOST_S)
            viewer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            viewer.sendall(asked)
            wait_until(lambda: threading.active_count() > before + 1)
            viewer.close()  # the connection is reset
            view.add(np.zeros((480, 640, 3), np.uint8))
        wait_until(lambda: threading.active_count() == before + 1)
    assert capsys.readouterr() == ("", "")
