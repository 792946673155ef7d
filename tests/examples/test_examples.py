"""Each program of examples/ runs as it stands and finds what is in its frames."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import trimesh

from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.simulation import looking_at
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
QUICK = TrainingOptions(
    order=2,
    bins=90,
    smooth_bins=3,
    resolution_px=128,
    perturbed_views=100,
    held_out_views=50,
    contour_radii=(1.0, 2.0),
    contour_resolution_px=256,
)


def test_examples_are_short():
    names = ("train_and_first_pose", "track_video", "fuse_three_sensors")
    for name in names:
        assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 25


def test_train_and_first_pose(
    tmp_path: Path, monkeypatch, bumpy_mesh: Mesh, camera: Camera, draw, capsys
):
    monkeypatch.chdir(tmp_path)
    trimesh.Trimesh(1000.0 * bumpy_mesh.vertices_m, bumpy_mesh.faces).export("bumpy.stl")
    save_camera(camera, "camera.yaml")
    truth = looking_at(np.array([9.0, 6.0, 5.0]), np.zeros(3), [0.0, 0.0, 1.0])
    cv2.imwrite("frame.png", draw(bumpy_mesh, truth, camera, np.random.default_rng(1)))
    program = runpy.run_path(str(EXAMPLES / "train_and_first_pose.py"))
    found = program["main"]("bumpy.stl", "mm", "camera.yaml", "frame.png", QUICK)
    assert found.pose is not None, found.reason
    assert np.rad2deg(found.pose.angle_to(truth)) < 2.0
    assert "quaternion wxyz:" in capsys.readouterr().out


def test_track_video(tmp_path: Path, tiny_model_path: Path, bumpy_mesh: Mesh, camera: Camera, draw):
    save_camera(camera, tmp_path / "camera.yaml")
    (tmp_path / "frames").mkdir()
    for k in range(4):
        place = 12.0 * np.array([np.cos(0.05 * k), np.sin(0.05 * k), 0.3])
        truth = looking_at(place, np.zeros(3), [0.0, 0.0, 1.0])
        picture = draw(bumpy_mesh, truth, camera, np.random.default_rng(k))
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), picture)
    arguments = [tiny_model_path, tmp_path / "frames", tmp_path / "camera.yaml", "drawn.mp4"]
    ran = subprocess.run(
        [sys.executable, EXAMPLES / "track_video.py", *arguments],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert (ran.returncode, len(ran.stdout.splitlines())) == (0, 4), ran
    drawn = cv2.VideoCapture(str(tmp_path / "drawn.mp4"))
    assert drawn.get(cv2.CAP_PROP_FRAME_COUNT) == 4
