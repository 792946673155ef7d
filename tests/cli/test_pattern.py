"""`rendezview calibrate pattern`: pictures, a log or a length, and the file it writes."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cli.reflector_runs import CAMERA, write_run

from rendezview.io.bundled import find_target
from rendezview.io.camera_files import save_camera
from rendezview.io.target import Target
from rendezview.io.target_writer import write_places
from rendezview.sensors.beacons import SixNumbers, patterns_of, pose_of

PLACES = {"left": [-0.184, 0, 0], "post": [0, 0, 0.1], "right": [0.184, 0, 0],
          "top": [0, 0.14, 0], "bottom": [0, -0.14, 0]}  # fmt: skip


@pytest.fixture(scope="module")
def mounted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A target file of five, a run of one whose 'top' is 2 mm off, and its camera."""
    folder = tmp_path_factory.mktemp("mounted")
    text = 'name = "five"\n# a comment\n'
    for name, place in PLACES.items():
        text += (
            f'[[reflectors]]\nname = "{name}"\ngroup = "all"\nposition_m = {place}\n'
            "normal = [0, 0, 1]\ndiameter_m = 0.025\n"
        )
    (folder / "five.toml").write_text(text)
    save_camera(CAMERA, folder / "camera.yaml")
    (pattern,) = patterns_of(Target.load(folder / "five.toml"))
    places = pattern.positions_m.copy()
    places[3, 0] += 2e-3
    true = replace(pattern, positions_m=places)
    sixes = (
        SixNumbers(
            3.0 - 0.06 * k, 0.08 * np.sin(k / 2), 0.06 * np.cos(k / 3), 0.02 * k,
            0.3 * np.sin(0.4 * k), 0.3 * np.cos(0.3 * k),
        )
        for k in range(20)
    )  # fmt: skip
    write_run(folder, true, (pose_of(six, true) for six in sixes))
    return folder


def test_pictures_and_their_log_name_the_reflector_that_is_off(run, mounted, tmp_path):
    five, out = mounted / "five.toml", tmp_path / "measured.toml"
    ran = run("calibrate", "pattern", mounted / "lit", mounted / "dark", "--target", five,
              "-o", out)  # fmt: skip
    assert ran.code == 0, ran
    assert "top is off by 2.0" in ran.err
    assert "half a turn" in ran.err
    assert "from 19 of 19 readings" in ran.err
    measured = Target.load(out)
    by = {reflector.name: reflector for reflector in measured.reflectors}
    np.testing.assert_allclose(by["top"].position_m, [2e-3, 0.14, 0.0], atol=1.5e-4)
    np.testing.assert_allclose(by["left"].position_m, PLACES["left"], atol=5e-5)
    assert all(0.0 < r.position_sigma_m < 3e-4 for r in measured.reflectors)
    # With the corrected file the same run has poses, which make a log.
    log, again = tmp_path / "log.jsonl", tmp_path / "again.toml"
    ran = run("reflectors", out, mounted / "lit", mounted / "dark", "-o", log)
    assert ran.code == 0, ran
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert sum(record["pose"] is not None for record in records) == 19
    ran = run("calibrate", "pattern", log, "--camera", mounted / "camera.yaml", "--target", out,
              "-o", again)  # fmt: skip
    assert ran.code == 0, ran
    assert "is off" not in ran.err
    assert "may be off" not in ran.err


def test_what_cannot_be_measured_is_said(run, mounted, tmp_path):
    out, log = tmp_path / "out.toml", tmp_path / "log.jsonl"
    log.write_text('{"time_s": 0.0}\n')
    for words, told in (
        ([log, "--target", mounted / "five.toml"], "a log has no camera"),
        ([log, "--target", mounted / "five.toml", "--camera", mounted / "camera.yaml"],
         "record 1: no line of a log of poses"),
        (["--target", "client", "--group", "far"], "say nothing of their places"),
        (["--target", "client", "--length", "far-left=1"], "NAME:NAME=METRES"),
        (["--target", "client", "--length", "far-left:far-right=0.37", "--length-error-mm", "0"],
         "must be positive"),
        ([0, "--target", "client", "--camera", mounted / "camera.yaml"], "recorded run"),
    ):  # fmt: skip
        ran = run("calibrate", "pattern", *words, "-o", out)
        assert ran.code == 1, ran
        assert told in ran.err
        assert not out.exists()


def test_a_length_alone_makes_the_file_of_a_print(run, tmp_path):
    assert run("calibrate", "card", "-o", tmp_path).code == 0
    out = tmp_path / "printed.toml"
    ran = run("calibrate", "pattern", "--target", tmp_path / "target.toml", "--length",
              "left:right=0.1261", "-o", out)  # fmt: skip
    assert ran.code == 0, ran
    assert "size 97.0" in ran.err
    left, _, right = Target.load(out).reflectors
    assert np.linalg.norm(right.position_m - left.position_m) == pytest.approx(0.1261, abs=1e-4)


def test_all_else_of_a_target_file_stays(tmp_path):
    client = find_target("client")
    assert client.source is not None
    out = tmp_path / "sub" / "measured.toml"
    out.parent.mkdir()
    write_places(client, {"near-left": (np.array([0.1, 0.2, 0.3]), 1.23456e-4)}, out)
    wanted, found = tomllib.loads(client.source.read_text()), tomllib.loads(out.read_text())
    (near,) = (one for one in wanted["reflectors"] if one["name"] == "near-left")
    near |= {"position_m": [0.1, 0.2, 0.3], "position_sigma_m": 1.23e-4}
    wanted["mesh"]["path"] = found["mesh"]["path"]
    assert found == wanted
    assert Target.load(out).mesh_path.samefile(client.mesh_path)
