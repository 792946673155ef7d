"""A log's path in the formats of TUM and KITTI: what a reader of its own takes from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.cli.export import export
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.io.results import JsonLinesWriter


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
