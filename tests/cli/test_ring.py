"""`rendezview ring`: a run read, drawn, and what cannot work told."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview_ground.simulate.ring_frames import RingSceneOptions, random_scene, render_ring_frame

CLIENT = Path(__file__).resolve().parents[2] / "models_cad" / "client"


@pytest.fixture(scope="module")
def ring_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    """Three frames of rings, and one that is no image."""
    folder = tmp_path_factory.mktemp("ring")
    camera = Camera.from_fov(640, 480, math.radians(40.0))
    save_camera(camera, folder / "camera.yaml")
    scenes = []
    for k in range(3):
        rng = np.random.default_rng([20, k])
        options = RingSceneOptions(tilt_rad=(0.4, 0.8), width_px=(240.0, 330.0))
        scenes.append(random_scene(camera, rng, options))
        cv2.imwrite(str(folder / f"{k:03d}.png"), render_ring_frame(scenes[k], rng))
    (folder / "003.png").write_bytes(b"\x89PNG cut short")
    return folder, scenes


def test_a_run_becomes_one_json_object_a_frame_and_pictures(run, ring_run, tmp_path):
    folder, scenes = ring_run
    log = tmp_path / "ring.jsonl"
    ran = run("ring", folder, "--radius-m", 0.6, "-o", log, "--overlay", tmp_path / "o",
              "--independent")  # fmt: skip
    assert ran.code == 0, ran
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [r["image"] for r in records] == ["000.png", "001.png", "002.png", "003.png"]
    assert records[3]["status"] == "unreadable"
    assert records[3]["poses"] == []
    for found, scene in zip(records[:3], scenes, strict=True):
        assert set(found) >= {"image", "time_s", "status", "reason", "ellipses", "poses"}
        best = found["ellipses"][0]
        assert set(best) >= {
            "centre_px", "semi_axes_px", "angle_rad", "covariance", "arc_deg", "score"
        }  # fmt: skip
        assert np.shape(best["covariance"]) == (5, 5)
        assert best["arc_deg"] > 300.0
        poses = found["poses"]
        assert set(poses[0]) >= {"centre_m", "axis", "covariance", "chosen", "reason"}
        assert np.shape(poses[0]["covariance"]) == (5, 5)
        assert sum(pose["chosen"] for pose in poses) <= 1
        near = min(np.linalg.norm(np.array(p["centre_m"]) - scene.ring.centre_m) for p in poses)
        assert near < 0.001 * np.linalg.norm(scene.ring.centre_m)
    assert cv2.imread(str(tmp_path / "o" / "000000.png")).shape == (480, 640, 3)


def test_without_an_output_file_the_lines_are_printed(run, ring_run):
    folder, _ = ring_run
    ran = run("ring", folder, "--target", "client")
    assert ran.code == 0
    assert len([json.loads(line) for line in ran.out.splitlines()]) == 4


def test_what_cannot_work_is_told_in_a_line(run, ring_run, tmp_path):
    folder, _ = ring_run
    run("ring", folder / "none").says("no such file")
    run("ring", folder, "--radius-m", -1).says("--radius-m", "positive")
    run("ring", folder, "--range-m", "nan").says("--range-m")
    run("ring", folder, "--range-sigma-m", 0.1).says("--range-m")
    run("ring", folder, "--target", "clint").says("clint", "client", "hubble")
    run("ring", folder, "--radius-m", 0.6, "--track", folder / "x.jsonl").says("--target")
    run("ring", folder, "--prior-axis", "0,0,0").says("--prior-axis")
    run("ring", folder, "--prior-axis", "scene").says("--target")
    run("ring", folder, "--target", CLIENT, "--prior-axis", "scene").says("does not give its pose")
    run("ring", folder, "--target", CLIENT.parent / "hubble").says("no docking_ring")
    run("ring", folder, "-o", tmp_path).says("file name")
    small = tmp_path / "small.yaml"
    save_camera(Camera.from_fov(320, 240, 0.7), small)
    ran = run("ring", folder, "--camera", small, "--radius-m", 0.6)
    ran.says("640 × 480", "320 × 240", "camera.yaml would fit")
