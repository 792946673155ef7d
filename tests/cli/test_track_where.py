"""`rendezview track --box`, `--boxes`, `--mask`, `--at`: where the target is."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.io.results import read_results
from rendezview.sensors.appearance.edges.contour_at import target_box
from rendezview_ground.simulate.bop_writer import BopSceneWriter


@pytest.fixture(scope="module")
def two_bodies(refining_model, bumpy_mesh, camera, draw, tmp_path_factory) -> tuple[Path, Pose]:
    """Two frames with the target twice, at its pose and at the other side of the frame."""
    folder, rng = tmp_path_factory.mktemp("two"), np.random.default_rng(5)
    rotation = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    range_m = 3.5 * refining_model.sphere_radius_m
    left, right = (
        Pose(rotation, np.array([x * range_m, 0.0, range_m]) - rotation @ refining_model.centre_m)
        for x in (-0.18, 0.18)
    )
    with BopSceneWriter(folder / "scene", camera) as scene:
        for k in range(2):
            images = [draw(bumpy_mesh, pose, camera, rng) for pose in (left, right)]
            scene.add(k, np.maximum(*images), left, float(k))
    return folder, left


def test_each_option_says_which_body_is_meant(run, refining_model, camera, two_bodies, tmp_path):
    folder, pose = two_bodies
    refining_model.save(tmp_path / "m.rvm")
    box = np.array(target_box(refining_model, camera, pose))
    xywh = [*box[:2].tolist(), *(box[2:] - box[:2]).tolist()]
    lines = [{"scene_id": 1, "image_id": k, "bbox": xywh, "score": 0.9} for k in range(2)]
    (tmp_path / "boxes.json").write_text(json.dumps(lines))
    mask = np.zeros((camera.height, camera.width), np.uint8)
    mask[:, : camera.width // 2] = cv2.imread(
        str(next((folder / "scene").rglob("000000.png"))), cv2.IMREAD_GRAYSCALE
    )[:, : camera.width // 2]
    cv2.imwrite(str(tmp_path / "mask.png"), np.where(mask > 40, 255, 0).astype(np.uint8))
    x, y = camera.project(pose.apply(refining_model.centre_m))
    asked = ("track", tmp_path / "m.rvm", folder / "scene", "-o", tmp_path / "p.csv")
    for option, value in (
        ("--box", ",".join(f"{side:.1f}" for side in xywh)),
        ("--boxes", tmp_path / "boxes.json"),
        ("--mask", tmp_path / "mask.png"),
        ("--at", f"{x:.0f},{y:.0f}"),
    ):
        ran = run(*asked, option, value, "--log", tmp_path / "log.jsonl")
        assert "2 poses in 2 frames" in ran.err, (option, ran)
        for line in (tmp_path / "log.jsonl").read_text().splitlines():
            place = json.loads(line)["pose"]["translation_m"]
            assert place == pytest.approx(pose.translation_m, abs=0.02 * pose.translation_m[2])


def test_each_instance_gets_a_pose_and_another_object_none(
    run, refining_model, bumpy_mesh, camera, draw, tmp_path
):
    """Three of the target in one frame, each turned otherwise, and a plate that is another's."""
    refining_model.save(tmp_path / "m.rvm")
    rng, range_m = np.random.default_rng(8), 4.5 * refining_model.sphere_radius_m
    poses, lines, pictures = [], [], []
    for k, (x, y) in enumerate([(-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2)]):
        rotation = Rotation.from_rotvec([0.4 * k, -0.7, 0.2 + k]).as_matrix()
        centre = np.array([x, y, 1.0]) * range_m
        poses.append(Pose(rotation, centre - rotation @ refining_model.centre_m))
        pictures.append(draw(bumpy_mesh, poses[-1], camera, rng))
        left, top, right, bottom = target_box(refining_model, camera, poses[-1])
        lines.append({"bbox": [left, top, right - left, bottom - top], "category_id": 1})
    frame = np.maximum.reduce(pictures)
    cv2.rectangle(frame, (270, 260), (330, 330), 150, -1)
    lines.append({"bbox": [270, 260, 60, 70], "category_id": 2})
    lines.append({"bbox": [268, 258, 64, 74], "category_id": 1, "score": 0.1})  # mistaken
    with BopSceneWriter(tmp_path / "scene", camera) as scene:
        scene.add(0, frame, poses[0], 0.0)
    lines = [{"scene_id": 1, "image_id": 0, "score": 0.9, **line} for line in lines]
    (tmp_path / "boxes.json").write_text(json.dumps(lines))
    asked = ("track", tmp_path / "m.rvm", tmp_path / "scene", "-o", tmp_path / "p.csv")
    many = ("--obj-id", 1, "--boxes", tmp_path / "boxes.json", "--instances", 5)
    run(*asked, "--instances", 2).says("--instances needs --boxes")
    assert "3 poses in 4 frames" in run(*asked, *many).err
    rows = read_results(tmp_path / "p.csv")
    assert [row.im_id for row in rows] == [0, 0, 0]
    for row, pose in zip(rows, poses, strict=True):
        assert row.camera_from_target.angle_to(pose) < np.deg2rad(5.0)
        away = row.camera_from_target.translation_m - pose.translation_m
        assert np.linalg.norm(away) < 0.03 * range_m


def test_a_wrong_place_is_said_before_the_frames_are_looked_at(
    run, refining_model, two_bodies, tmp_path
):
    refining_model.save(tmp_path / "m.rvm")
    asked = ("track", tmp_path / "m.rvm", two_bodies[0] / "scene", "-o", tmp_path / "p.csv")
    run(*asked, "--box", "1,2,3").says("--box needs 4 numbers")
    run(*asked, "--box", "1,2,3,4", "--at", "1,2").says("give one of --box, --at")
    run(*asked, "--boxes", tmp_path / "none.json").says("none.json")
    run(*asked, "--at", "9000,2").says("outside")
