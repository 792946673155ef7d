"""Recordings as sources of `track`, and runs handed on to Rerun, as commands."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.io.bags import Shot, write_foxglove, write_ros1, write_ros2

from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import ViewModel


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory, tiny_model: ViewModel) -> Path:
    path = tmp_path_factory.mktemp("model") / "bumpy.rvm"
    tiny_model.save(path)
    return path


def poses(csv: Path) -> list[list[str]]:
    """Everything but the times that it took."""
    return [line.split(",")[1:6] for line in csv.read_text().splitlines()]


@pytest.mark.parametrize(
    ("write", "name"),
    [(write_ros1, "a.bag"), (write_ros2, "a"), (write_foxglove, "a.mcap")],
    ids=["ros1", "ros2", "foxglove"],
)
def test_a_recording_is_tracked_as_its_pictures_are(
    run, scene: Path, model_path: Path, prior_path: Path, tmp_path: Path, write, name: str
):
    sequence = open_sequence(scene)
    shots = [Shot(frame.read(), float(k)) for k, frame in enumerate(sequence)]
    camera = sequence.frames[0].camera
    path = write(tmp_path / name, shots, {"/camera/camera_info": camera})
    assert (
        run("track", model_path, scene, "-o", tmp_path / "1.csv", "--prior", prior_path).code == 0
    )
    ran = run(
        *("track", model_path, f"{path}#/camera/image_raw", "-o", tmp_path / "2.csv"),
        *("--prior", prior_path),
    )
    assert ran.code == 0, ran
    found = poses(tmp_path / "2.csv")
    assert len(found) > 5
    assert found == poses(tmp_path / "1.csv")
    run("track", model_path, f"{path}#/no", "-o", tmp_path / "3.csv").says("no pictures of /no")


def test_a_run_becomes_a_rerun_recording(
    run, scene: Path, model_path: Path, prior_path: Path, tmp_path: Path
):
    reader = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk").RrdReader
    log, out = tmp_path / "log.jsonl", tmp_path / "run.rrd"
    files = ("-o", tmp_path / "1.csv", "--log", log)
    assert run("track", model_path, scene, *files, "--prior", prior_path).code == 0
    ran = run("rrd", log, "-o", out, "--scene", scene, "--model", model_path)
    assert (ran.code, ran.err) == (0, f"{out}: 9 frames\n")
    chunks = reader(out).stream().to_chunks()
    assert sum(c.num_rows for c in chunks if str(c.entity_path) == "/target") == 9
    run("rrd", tmp_path / "no.jsonl", "-o", out).says("no.jsonl", "no such file")
    run("rrd", scene / "scene_gt.json", "-o", out).says("scene_gt.json")
    run("rrd", model_path, "-o", out).says("bumpy.rvm")
    run("rrd", tmp_path / "run.mcap", "-o", out, "--scene", scene).says("leave out --scene")
