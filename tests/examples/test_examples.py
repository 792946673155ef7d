"""Each program of examples/ runs as it stands and finds what is in its frames."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from tests.processes import python
from tests.quick_training import REFINING

from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, simulate
from rendezview_ground.simulate.trajectories import looking_at

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(example: str, *arguments: object, cwd: Path) -> list[str]:
    """The lines that an example prints, started as a person starts it."""
    ran = python(EXAMPLES / example, *arguments, cwd=cwd)
    assert ran.returncode == 0, ran
    return ran.stdout.splitlines()


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
    options = replace(REFINING, order=1)
    found = program["main"]("bumpy.stl", "mm", "camera.yaml", "frame.png", options)
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
    lines = run(
        "track_video.py", tiny_model_path, "frames", "camera.yaml", "drawn.mp4", cwd=tmp_path
    )
    assert len(lines) == 4
    drawn = cv2.VideoCapture(str(tmp_path / "drawn.mp4"))
    assert drawn.get(cv2.CAP_PROP_FRAME_COUNT) == 4


RING_CENTRE_M, RING_RADIUS_M = np.array([-0.4, 0.0, -0.41]), 0.35


def with_ring(mesh: Mesh) -> Mesh:
    """The bumpy body with a dark ring on one of its faces."""
    ring = trimesh.creation.annulus(r_min=0.3, r_max=RING_RADIUS_M, height=0.02, sections=96)
    ring.apply_translation(RING_CENTRE_M)
    vertices = np.concatenate([mesh.vertices_m, ring.vertices])
    faces = np.concatenate([mesh.faces, ring.faces + len(mesh.vertices_m)]).astype(np.int32)
    grey = np.concatenate([np.full((len(mesh.faces), 3), 0.6), np.full((len(ring.faces), 3), 0.02)])
    return Mesh(vertices, faces, grey.astype(np.float32), ())


def test_fuse_three_sensors(
    tmp_path: Path, refining_model: ViewModel, bumpy_mesh: Mesh, camera: Camera
):
    poses = [
        (float(k), looking_at([-0.8, 0.5, -9.0 + 0.3 * k], RING_CENTRE_M, [0.0, 1.0, 0.0]))
        for k in range(8)
    ]
    mesh, options = with_ring(bumpy_mesh), SceneOptions(sun_phase_rad=0.2)
    simulate(mesh, camera, poses, options, tmp_path / "scene", 1)
    # The model does not know the ring: its mesh may be off by half a percent.
    replace(refining_model, shape_error=0.005).save(tmp_path / "model.rvm")
    trimesh.Trimesh(mesh.vertices_m, mesh.faces).export(tmp_path / "bumpy.stl")
    (tmp_path / "target.toml").write_text(
        f"""name = "bumpy"
        description = "a body with a ring"
        [mesh]
        path = "bumpy.stl"
        unit = "m"
        [docking_ring]
        centre_m = {RING_CENTRE_M.tolist()}
        axis = [0.0, 0.0, -1.0]
        radius_m = {RING_RADIUS_M}
        """
    )
    normal = np.array([0.0, 0.0, -1.0])
    with open(tmp_path / "laser.jsonl", "w") as laser:
        for time_s, pose in poses:  # along the boresight to the ring's plane
            across = pose.rotation @ normal
            range_m = across @ pose.apply(RING_CENTRE_M) / across[2]
            laser.write(json.dumps({"time_s": time_s, "range_m": range_m, "sigma_m": 0.01}) + "\n")
    lines = run(
        "fuse_three_sensors.py", "model.rvm", "scene", "target.toml", "laser.jsonl", cwd=tmp_path
    )
    assert len(lines) == 8 + 3
    used = {line.split()[0]: int(line.split()[1]) for line in lines[-3:]}
    assert used["camera"] >= 6
    assert used["ring"] >= 4
    assert used["laser"] >= 4
    time_s, status, place = lines[7].split(maxsplit=2)
    assert status == "tracking"
    np.testing.assert_allclose(
        np.array(place.strip("[]").split(), float), poses[-1][1].translation_m, atol=0.05
    )
