"""``rendezview show`` on every kind of file, and ``evaluate --plots``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.ground.evaluate.figures import pixels

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import exp
from rendezview.io.camera_files import save_camera
from rendezview.io.results import JsonLinesWriter, ResultRow, write_results
from rendezview.sensors.beacons import Rig, RigCamera
from rendezview.sensors.beacons.rig_files import save_rig
from rendezview_ground.evaluate.evaluation import Evaluation, FrameResult
from rendezview_ground.evaluate.pictures.camera_pictures import camera_picture, rig_picture
from rendezview_ground.evaluate.pictures.error_pictures import share_picture
from rendezview_ground.evaluate.pictures.log_pictures import (
    measurement_picture,
    track_of_records,
    track_picture,
)
from rendezview_ground.evaluate.pose_errors import pose_errors
from rendezview_ground.evaluate.show_command import show

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (-0.2, 0.05, 0.0, 0.0))


def pose(k: int) -> Pose:
    return Pose(exp(np.array([0.0, 0.1 * k, 0.0])), np.array([0.0, 0.0, 10.0 - 0.1 * k]))


def line(k: int, **more: Any) -> dict[str, Any]:
    lost = 3 <= k < 6
    covariance = np.diag([1e-6] * 3 + [1e-4, 1e-4, 4e-4])
    return {
        "time_s": 1.7e9 + k,
        "status": "lost" if lost else "ok",
        "pose": None if lost else pose(k),
        "covariance": None if lost else covariance,
        **more,
    }


def write(path: Path, records: list[dict[str, Any]]) -> Path:
    with JsonLinesWriter(path) as log:
        for record in records:
            log.write(record)
    return path


def ring_line(k: int) -> dict[str, Any]:
    found = k != 4
    ellipse = {"semi_axes_px": [40.0 + k, 20.0], "centre_px": [1.0, 2.0]}
    circle = {"centre_m": [0.0, 0.0, 5.0 - 0.2 * k], "axis": [0.0, 0.6, -0.8], "chosen": True}
    return {
        "time_s": float(k),
        "status": "ok" if found else "empty",
        "ellipses": [ellipse, ellipse] if found else [],
        "ellipse": 0 if found else None,
        "poses": [circle | {"chosen": False}, circle] if found else [],
    }


def fused_line(k: int) -> dict[str, Any]:
    measured = {
        "sensor": "ring" if k % 2 else "appearance",
        "accepted": k != 7,
        "nis": 6.0 + k,
        "degrees_of_freedom": 6,
    }
    return line(k, measurement=measured) | {"status": "tracking" if k > 2 else "waiting"}


@pytest.mark.parametrize(
    ("records", "pictures"),
    [
        ([line(k) for k in range(10)], {"track.png"}),
        ([line(k, on_nodes=[1, 2], points_m=[[1.0, 2.0, 3.0]]) for k in range(10)],
         {"track.png", "curves.png", "cloud.png"}),
        ([ring_line(k) for k in range(10)], {"ring.png"}),
        ([fused_line(k) for k in range(10)], {"track.png", "measurements.png"}),
        ([{"time_s": float(k), "range_m": None if k == 2 else 9.0 - k} for k in range(6)],
         {"range.png"}),
    ],
    ids=["poses", "track", "ring", "fuse", "ranger"],
)  # fmt: skip
def test_every_log_is_drawn(
    tmp_path: Path, records: list[dict[str, Any]], pictures: set[str]
) -> None:
    show(write(tmp_path / "log.jsonl", records), tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == pictures
    for path in (tmp_path / "out").iterdir():
        picture = cv2.imread(str(path))
        assert picture.shape[1] > 600
        assert picture.std() > 5.0


def test_the_log_of_a_run_that_broke_off_is_drawn(tmp_path: Path) -> None:
    log = write(tmp_path / "log.jsonl", [line(k) for k in range(10)])
    show(log.rename(tmp_path / "log.jsonl.partial"), tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["track.png"]


def test_results_rigs_and_cameras_are_drawn(tmp_path: Path) -> None:
    write_results(tmp_path / "poses.csv", [ResultRow(1, k, 1, 0.9, pose(k)) for k in range(8)])
    show(tmp_path / "poses.csv", tmp_path / "results")
    assert {path.name for path in (tmp_path / "results").iterdir()} == {"track.png", "cloud.png"}
    beside = Pose(exp(np.array([0.0, -0.2, 0.0])), np.array([-0.4, 0.0, 0.0]))
    rig = Rig(
        (
            RigCamera.from_camera("left", CAMERA, Pose.identity()),
            RigCamera.from_camera("right", CAMERA, beside),
        )
    )
    save_rig(rig, tmp_path / "rig.json")
    show(tmp_path / "rig.json", tmp_path / "rig")
    assert [path.name for path in (tmp_path / "rig").iterdir()] == ["rig.png"]
    assert "0.4 m" in rig_picture(rig).axes[0].get_title(loc="left")
    save_camera(CAMERA, tmp_path / "camera.yaml")
    show(tmp_path / "camera.yaml", tmp_path / "camera")
    assert [path.name for path in (tmp_path / "camera").iterdir()] == ["camera.png"]


@pytest.mark.parametrize("lens", ["pinhole", "barrel", "fisheye"])
def test_a_cameras_title_has_its_field_of_view(lens: str) -> None:
    camera = {
        "pinhole": CAMERA.pinhole,
        "barrel": CAMERA,
        "fisheye": replace(CAMERA, distortion=(0.0,) * 4, lens_model=LensModel.FISHEYE),
    }[lens]
    title = camera_picture(camera).axes[0].get_title(loc="left")
    if lens == "pinhole":
        assert f"{2.0 * np.degrees(np.arctan(320.0 / 500.0)):.1f}°" in title
        assert "pinhole" in title
    if lens == "fisheye":  # r = f θ
        assert f"{2.0 * np.degrees(320.0 / 500.0):.1f}°" in title


def test_a_pinhole_whose_rays_are_rounded_moves_nothing() -> None:
    camera = Camera(640, 480, 617.2, 617.7, 318.48, 241.17)
    figure = camera_picture(camera)
    figure.canvas.draw()  # the arrows' scale was 0 / 0 here
    words = [text.get_text() for text in figure.axes[0].texts]
    assert words == ["no distortion", "principal point"]


def test_a_track_has_the_distance_its_sigma_and_the_turn_since_the_first_pose() -> None:
    records = json.loads(
        json.dumps([line(k) | {"pose": pose(k).as_dict(), "covariance": None} for k in range(3)])
    )
    records[2]["covariance"] = np.diag([4e-4] * 3 + [1e-4, 1e-4, 9e-4]).tolist()
    track = track_of_records(records, "log")
    np.testing.assert_allclose(track.distance_m, [10.0, 9.9, 9.8])
    np.testing.assert_allclose(track.turned_rad, [0.0, 0.1, 0.2], atol=1e-7)
    np.testing.assert_allclose(track.distance_sigma_m, [np.nan, np.nan, 0.03])
    np.testing.assert_allclose(track.attitude_sigma_rad, [np.nan, np.nan, 0.02])
    assert track.x_label.startswith("time since 1700000000")
    assert pixels(track_picture(track, "log")).shape[2] == 3


def test_without_measurements_there_is_no_picture_of_them() -> None:
    assert measurement_picture([{"time_s": 0.0, "measurement": None}]) is None


def test_a_curve_ends_at_the_share_of_frames_with_a_pose() -> None:
    right = pose_errors(pose(0), pose(1))
    frames = tuple(FrameResult(k, str(k), None, right if k < 3 else None) for k in range(4))
    figure = share_picture({"ours": Evaluation(frames), "theirs": Evaluation(frames[:3])})
    ours, theirs = figure.axes[0].get_lines()[:2]
    assert ours.get_ydata()[-1] == pytest.approx(75.0)
    assert theirs.get_ydata()[-1] == pytest.approx(100.0)
    assert ours.get_linestyle() != theirs.get_linestyle()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.jsonl", '{"status": "ok"}\n', "not a log of poses"),
        ("a.jsonl", '{"ellipses": 3, "poses": [], "ellipse": null, "status": "ok"}\n', "ring"),
        ("a.jsonl", '{"range_m": "far"}\n', "not a log of a ranger"),
        ("a.csv", "a,b\n", "these are not BOP results"),
        ("a.json", "{}", "no camera matrix"),
    ],
)
def test_what_is_no_such_file_is_refused(
    tmp_path: Path, name: str, content: str, words: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(RendezviewError, match=words):
        show(tmp_path / name, tmp_path / "out")


def test_cameras_of_colmap_are_drawn_and_a_picture_is_no_folder(tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("# Camera list\n1 PINHOLE 640 480 641.8 641.8 320 240\n")
    show(cameras, tmp_path / "out")
    assert (tmp_path / "out" / "camera.png").is_file()
    with pytest.raises(RendezviewError, match="name one, not a picture"):
        show(cameras, tmp_path / "camera.png")
    assert not (tmp_path / "camera.png").exists()
