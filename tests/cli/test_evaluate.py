"""``rendezview evaluate`` on the data of peers: SPEED folders, BOP models, several results."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import ResultRow, write_results
from rendezview_ground.simulate.bop_writer import BopSceneWriter

CAMERA = Camera.from_fov(64, 48, 1.0)


def poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(31)
    turns = Rotation.random(count, random_state=rng).as_matrix()
    return [Pose(turn, [0.1, -0.2, 9.0 + k]) for k, turn in enumerate(turns)]


def write(path: Path, found: list[Pose | None], scene_id: int = 1) -> Path:
    rows = [ResultRow(scene_id, k, 1, 0.9, p, 0.01) for k, p in enumerate(found) if p is not None]
    write_results(path, rows)
    return path


@pytest.fixture
def speed_plus(tmp_path: Path) -> Path:
    """A folder as SPEED+ has them, whose quaternion is that of the passive turn's transpose."""
    labels = []
    folder = tmp_path / "speedplus" / "sunlamp"
    (folder / "images").mkdir(parents=True)
    for k, pose in enumerate(poses(3)):
        name = f"img{k:06d}.jpg"
        cv2.imwrite(str(folder / "images" / name), np.zeros((48, 64), np.uint8))
        w, x, y, z = pose.quat_wxyz
        quat2dcm_first_row = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        np.testing.assert_allclose(pose.rotation.T[0], quat2dcm_first_row, atol=1e-12)
        labels.append(
            {
                "filename": name,
                "q_vbs2tango_true": [w, x, y, z],
                "r_Vo2To_vbs_true": pose.translation_m.tolist(),
            }
        )
    (folder / "test.json").write_text(json.dumps(labels))
    camera = {"Nu": 64, "Nv": 48, "ppx": 1e-5, "ppy": 1e-5, "fx": 8e-4, "fy": 8e-4}
    (folder.parent / "camera.json").write_text(json.dumps(camera))
    return folder


def test_a_speed_plus_folder_gets_that_challenges_score(run, speed_plus: Path, tmp_path: Path):
    one, two, three = poses(3)
    found = [
        one.perturbed([np.deg2rad(0.1), 0, 0, 0, 0, 0.001]),  # both forgiven
        two.perturbed([0, np.deg2rad(2.0), 0, 0, 0, 0.0]),
        three.perturbed([0, 0, 0, 0.3, 0.0, 0.0]),
    ]
    csv = write(tmp_path / "ours.csv", found)
    ran = run("evaluate", speed_plus, csv, "--json")
    assert ran.code == 0
    ranges = [float(np.linalg.norm(p.translation_m)) for p in (one, two, three)]
    plus = np.deg2rad(2.0) + 0.3 / ranges[2]
    report = json.loads(ran.out)
    assert report["scores"]["speed_plus"] == pytest.approx(plus / 3.0)
    speed = plus + np.deg2rad(0.1) + 0.001 / ranges[0]
    assert report["scores"]["speed"] == pytest.approx(speed / 3.0)
    assert report["scores"]["rbot_share"] == pytest.approx(2.0 / 3.0)
    text = run("evaluate", speed_plus, csv).out
    assert f"{plus / 3.0:.4f}" in text
    assert "SPEED+ score, mean" in text


def test_several_results_are_compared_side_by_side(run, speed_plus: Path, tmp_path: Path):
    first, second = poses(3), [p.perturbed([0.2, 0, 0, 0, 0, 0]) for p in poses(3)]
    ours = write(tmp_path / "ours.csv", list(first))
    theirs = write(tmp_path / "theirs.csv", [None, *second[1:]])
    ran = run("evaluate", speed_plus, ours, theirs, "--json")
    report = json.loads(ran.out)
    assert [part["file"] for part in report["results"]] == ["ours", "theirs"]
    assert [part["found"] for part in report["results"]] == [3, 2]
    assert report["common_frames"] == 2
    text = run("evaluate", speed_plus, ours, theirs).out
    assert "ours" in text
    assert "theirs" in text
    (tmp_path / "other").mkdir()
    again = write(tmp_path / "other" / "ours.csv", list(second))
    report = json.loads(run("evaluate", speed_plus, ours, again, "--json").out)
    assert [part["file"] for part in report["results"]] == [str(ours), str(again)]
    run("evaluate", speed_plus, ours, ours).says("ours.csv", "given twice")
    run("evaluate", speed_plus, ours, tmp_path / "no.csv").says("no.csv", "no such file")


def test_a_bop_model_brings_its_unit_its_symmetries_and_its_diameter(run, tmp_path: Path):
    models = tmp_path / "models"
    models.mkdir()
    trimesh.creation.box((100.0, 100.0, 300.0)).export(models / "obj_000001.ply")
    quarter = np.eye(4)
    quarter[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    info = {"diameter": 380.0, "symmetries_discrete": [quarter.ravel().round(9).tolist()]}
    (models / "models_info.json").write_text(json.dumps({"1": info}))
    scene = tmp_path / "000004"
    with BopSceneWriter(scene, CAMERA) as writer:
        for k, pose in enumerate(poses(2)):
            writer.add(k, np.zeros((48, 64), np.uint8), pose, None)
    turned = [pose @ Pose(quarter[:3, :3], np.zeros(3)) for pose in poses(2)]
    csv = write(tmp_path / "turned.csv", list(turned), 4)
    report = json.loads(
        run("evaluate", scene, csv, "--target", models / "obj_000001.ply", "--json").out
    )
    assert report["scores"]["mssd_recall"] == 1.0
    assert report["scores"]["mspd_recall"] == 1.0
    assert report["scores"]["rbot_share"] == 1.0
    surface = report["per_frame"][0]["surface"]
    assert surface["diameter_m"] == 0.38
    assert surface["mssd_m"] < 1e-6
    assert surface["add_m"] > 0.05  # which knows no symmetries
    (models / "models_info.json").write_text(json.dumps({"1": {"diameter": 380.0}}))
    report = json.loads(
        run("evaluate", scene, csv, "--target", models / "obj_000001.ply", "--json").out
    )
    assert report["scores"]["rbot_share"] == 0.0
    assert report["scores"]["mssd_recall"] == pytest.approx(0.5)  # 0.1 m of 0.38 m
