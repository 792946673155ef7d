"""``rendezview track --integrity-risk`` and what ``evaluate`` makes of its log."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Run
from tests.conftest import Draw

from rendezview.geometry import so3
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import read_json_lines
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.bop_writer import BopSceneWriter

FRAMES = 4


@pytest.fixture
def approach(
    tmp_path: Path, bumpy_mesh: Mesh, refining_model: ViewModel, camera: Camera, draw: Draw
) -> tuple[Path, Path]:
    """A model and a scene of a slow turn."""
    model_path, scene = tmp_path / "bumpy.rvm", tmp_path / "scene"
    refining_model.save(model_path)
    rng = np.random.default_rng(4)
    with BopSceneWriter(scene, camera) as writer:
        for k in range(FRAMES):
            pose = Pose(so3.exp(np.array([0.4 + 0.01 * k, 0.7, -0.3])), np.array([0.1, 0.0, 6.0]))
            writer.add(k, draw(bumpy_mesh, pose, camera, rng), pose, float(k))
    return model_path, scene


@pytest.mark.requirement("RV-INT-5")
def test_levels_and_alarms_reach_the_log_the_summary_and_evaluate(
    approach: tuple[Path, Path], tmp_path: Path, run: Run
):
    log, results = tmp_path / "log.jsonl", tmp_path / "poses.csv"
    words = [*approach, "-o", results, "--log", log, "--prior", "scene", "--no-sketch"]
    done = run("track", *words, "--integrity-risk", 1e-3, "--alarm-attitude-deg", 1e-4)
    assert done.code == 0, done.err
    assert f"0 of {FRAMES} poses without an alarm" in done.err
    lines = [line["protection"] for line in read_json_lines(log)]
    assert len(lines) == FRAMES
    assert all(line["risk"] == 1e-3 and "attitude" in line["alarms"] for line in lines)
    assert all(line["alarm"] and len(line["axes"]) == 6 for line in lines)
    plots = tmp_path / "plots"
    done = run("evaluate", approach[1], results, "--log", log, "--plots", plots)
    assert f"protection levels of {FRAMES} poses: 0 misleading" in done.out.replace("\n", " ")
    assert (plots / "stanford.png").is_file()
    done = run("evaluate", approach[1], results, "--log", log, "--json")
    assert json.loads(done.out)["protection"]["alarms"] == FRAMES


def test_without_the_option_the_log_is_as_before(
    approach: tuple[Path, Path], tmp_path: Path, run: Run
):
    log = tmp_path / "log.jsonl"
    done = run("track", *approach, "-o", tmp_path / "p.csv", "--log", log, "--prior", "scene")
    assert done.code == 0, done.err
    assert "protection" not in done.err
    assert all("protection" not in line for line in read_json_lines(log))


def test_a_risk_that_cannot_be_is_told(approach: tuple[Path, Path], tmp_path: Path, run: Run):
    done = run("track", *approach, "-o", tmp_path / "p.csv", "--integrity-risk", 0.5)
    done.says("integrity risk", "0.1", "0.5")
