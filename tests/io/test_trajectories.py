"""A log's path in the formats of TUM and KITTI: what a reader of its own takes from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.cli.export import export
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.pose_log import read_pose
from rendezview.io.results import JsonLinesWriter
from rendezview.io.sequences.frame import Frame, Sequence
from rendezview.io.trajectories import poses_of_log, tum_text
from rendezview_ground.evaluate.tum import results_of_tum


def log_of(path: Path, times_s) -> list[Pose]:
    rng = np.random.default_rng(4)
    poses = [
        Pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0.0, 9.0, 3))
        for _ in times_s
    ]
    with JsonLinesWriter(path) as log:
        for time_s, pose in zip(times_s, poses, strict=True):
            log.write({"time_s": time_s, "pose": pose})
            log.write({"time_s": time_s, "pose": None})
    return poses


def test_a_tum_file_holds_the_camera_about_the_target(tmp_path, capsys):
    times_s = [0.0, 0.25, 1_790_000_000.123456]
    poses = log_of(tmp_path / "log.jsonl", times_s)
    export(tmp_path / "log.jsonl", tum=tmp_path / "path.tum")
    table = np.loadtxt(tmp_path / "path.tum")
    np.testing.assert_allclose(table[:, 0], times_s, atol=1e-6)
    for row, pose in zip(table, poses, strict=True):
        rotation = Rotation.from_quat(row[4:]).as_matrix()
        np.testing.assert_allclose(rotation, pose.rotation.T, atol=1e-9)
        np.testing.assert_allclose(pose.rotation @ row[1:4] + pose.translation_m, 0.0, atol=1e-9)
    assert "3 poses; 3 frames have none" in capsys.readouterr().err


def test_a_kitti_file_holds_it_without_times(tmp_path):
    poses = log_of(tmp_path / "log.jsonl", [None, None])
    export(tmp_path / "log.jsonl", kitti=tmp_path / "path.txt")
    for row, pose in zip(np.loadtxt(tmp_path / "path.txt"), poses, strict=True):
        np.testing.assert_allclose(row.reshape(3, 4), pose.inverse().as_matrix()[:3], atol=1e-9)


def test_what_cannot_be_written_is_said(tmp_path):
    log_of(tmp_path / "log.jsonl", [None])
    with pytest.raises(RendezviewError, match="TUM files need times"):
        export(tmp_path / "log.jsonl", tum=tmp_path / "path.tum")
    assert not (tmp_path / "path.tum").exists()
    (tmp_path / "none.jsonl").write_text('{"time_s": 0.0, "pose": null}\n')
    (tmp_path / "other.jsonl").write_text('{"a": 1}\n')
    for name, words in (("none", "none of its 1 lines"), ("other", "no line of a log")):
        with pytest.raises(RendezviewError, match=words):
            export(tmp_path / f"{name}.jsonl", kitti=tmp_path / "path.txt")
    with pytest.raises(RendezviewError, match="choose what to export"):
        export(tmp_path / "log.jsonl", tum=tmp_path / "a", kitti=tmp_path / "b")


def test_a_tum_file_of_a_peer_gives_the_poses_of_the_frames_of_its_times(tmp_path):
    times_s = [5.0, 5.5, 6.0]
    poses = log_of(tmp_path / "log.jsonl", times_s)
    text = "# time x y z qx qy qz qw\n\n" + tum_text(zip(times_s, poses, strict=True))
    (tmp_path / "peer.tum").write_text(text)
    camera = Camera.from_fov(64, 48, 0.5)
    frames = [Frame(k, str(k), time_s, camera, None, 1, np.zeros) for k, time_s in
              enumerate([4.0, 5.004, 5.5, 7.0, None])]  # fmt: skip
    sequence = Sequence(2, tuple(frames), Path("scene"))
    rows = results_of_tum(tmp_path / "peer.tum", sequence)
    assert [(row.scene_id, row.im_id) for row in rows] == [(2, 1), (2, 2)]
    for row, pose in zip(rows, poses, strict=False):
        np.testing.assert_allclose(row.camera_from_target.as_matrix(), pose.as_matrix(), atol=1e-9)
    with pytest.raises(RendezviewError, match="none of its 3 poses has the time"):
        results_of_tum(tmp_path / "peer.tum", Sequence(2, (frames[0],), Path("scene")))
    (tmp_path / "bad.tum").write_text("1 2 3\n")
    with pytest.raises(RendezviewError, match="line 1: not `time x y z"):
        results_of_tum(tmp_path / "bad.tum", sequence)


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ('{"quat_wxyz": ["1", 0, 0, 0]}', "quat_wxyz.0"),
        ('{"quat_wxyz": [true, 0, 0, 0]}', "quat_wxyz.0"),
        ('{"quat_wxyz": [0, 0, 0, 0]}', "quat_wxyz: must be a rotation"),
        ('{"quat_wxyz": [1e308, 1e308, 0, 0]}', "quat_wxyz: must be a rotation"),
        ('{"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, "5"]}', "translation_m.2"),
        ('{"quat": [1, 0, 0, 0]}', "quat_wxyz: missing"),
        ("[1, 0, 0, 0]", "an object"),
    ],
)
def test_a_pose_in_a_file_has_numbers_and_no_strings(tmp_path, content, key):
    path = tmp_path / "prior.json"
    path.write_text(content)
    with pytest.raises(RendezviewError, match=f"prior.json: no pose: .*{key}"):
        read_pose(path, "a prior pose", [0.0, 0.0, 9.0])
    path.write_text('{"quat_wxyz": [2, 0, 0, 0]}')
    assert read_pose(path, "a prior pose", [0.0, 0.0, 9.0]).translation_m.tolist() == [0, 0, 9]


def test_a_log_of_poses_has_numbers_and_no_strings(tmp_path):
    path = tmp_path / "log.jsonl"
    log_of(path, [0.5])
    path.write_text(path.read_text().replace('"time_s": 0.5', '"time_s": "0.5"'))
    with pytest.raises(RendezviewError, match=r"record 1: .*time_s: input should be a valid"):
        poses_of_log(path)
