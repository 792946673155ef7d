"""`rendezview reflectors`: a run read, calibrated, drawn, and what cannot work told."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cli.reflector_runs import CAMERA, CLIENT, write_run

from rendezview.io.camera_files import save_camera
from rendezview.io.target import Target
from rendezview.sensors.beacons import SixNumbers, patterns_of, pose_of


@pytest.fixture(scope="module")
def reflector_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen readings from 4 m to 2.5 m with their truth, and the same pictures in turn."""
    folder = tmp_path_factory.mktemp("reflectors")
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    (folder / "turns").mkdir()
    save_camera(CAMERA, folder / "turns" / "camera.yaml")
    sixes = (
        SixNumbers(
            4.0 - 0.1 * k, 0.05 * np.sin(k / 2), 0.04 * np.cos(k / 3), 0.02 * k,
            0.2 * np.sin(0.7 * k), 0.2 * np.cos(0.5 * k),
        )
        for k in range(16)
    )  # fmt: skip
    pairs = write_run(folder, pattern, (pose_of(six, pattern) for six in sixes))
    for number, picture in enumerate(itertools.chain(*pairs)):
        cv2.imwrite(str(folder / "turns" / f"{number:03d}.png"), picture)
    return folder


def test_a_run_becomes_readings_pictures_and_a_calibration(run, reflector_run, tmp_path):
    lit, dark = reflector_run / "lit", reflector_run / "dark"
    constants, log = tmp_path / "c.json", tmp_path / "r.jsonl"
    ran = run("calibrate", "reflectors", lit, dark, "--target", CLIENT, "--group", "far",
              "-o", constants)  # fmt: skip
    assert ran.code == 0, ran
    ran = run("reflectors", lit, dark, "--target", CLIENT, "-o", log, "--overlay",
              tmp_path / "o", "--calibration", constants)  # fmt: skip
    assert ran.code == 0, ran
    assert "15 poses in 16 readings (1 unconfirmed)" in ran.err
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert set(records[5]) >= {
        "spots", "triplet", "pose", "rates", "covariance", "status", "reason", "stage_ms"
    }  # fmt: skip
    assert records[0]["pose"] is None
    assert records[5]["six"]["range_m"] == pytest.approx(3.5, rel=0.005)
    assert records[5]["closed_form"]["range_m"] == pytest.approx(3.5, rel=0.01)
    assert [records[5]["spots"][k]["reflector"] for k in records[5]["triplet"]] == [
        "far-left", "far-middle", "far-right"
    ]  # fmt: skip
    assert cv2.imread(str(tmp_path / "o" / "000005.png")).shape == (768, 1024, 3)


def test_a_group_that_is_not_there_gives_no_pose_of_the_one_that_is(run, reflector_run, tmp_path):
    """The groups have one shape: only the size of the dots tells them apart."""
    lit, dark = reflector_run / "lit", reflector_run / "dark"
    log = tmp_path / "r.jsonl"
    ran = run("reflectors", lit, dark, "--target", CLIENT, "--group", "near", "-o", log)
    assert ran.code == 0, ran
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert {record["status"] for record in records} == {"ambiguous"}
    assert "the group 'far', which is left out" in records[0]["reason"]
    ran = run("reflectors", lit, dark, "--target", CLIENT, "--group", "far", "-o", log)
    assert "15 poses in 16 readings" in ran.err
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert all(record["note"] is None for record in records if record["pose"])


def test_lit_and_dark_in_turn_are_pairs(run, reflector_run, tmp_path):
    ran = run("reflectors", reflector_run / "turns", "--target", CLIENT)
    assert ran.code == 0
    assert "15 poses in 16 readings" in ran.err


def test_what_cannot_work_is_told_in_a_line(run, reflector_run, tmp_path):
    lit, dark, turns = (reflector_run / n for n in ("lit", "dark", "turns"))
    run("reflectors", lit, dark, lit, "--target", CLIENT).says("mode pairs takes 1")
    run("reflectors", lit, dark, "--target", CLIENT.parent / "hubble").says("no reflectors")
    run("reflectors", lit, dark, "--target", CLIENT, "--group", "x").says("no reflector group")
    run("reflectors", "calibrate", "--target", CLIENT).says("name the run")
    run("reflectors", "calibrate", lit, dark, "--target", CLIENT).says("-o")
    run("reflectors", "calibrate", turns, "--target", CLIENT, "-o", tmp_path / "c").says("true")
    run("reflectors", lit, dark, "--target", CLIENT, "--lit-from-dark", "1,2").says("six numbers")
    (tmp_path / "bad.json").write_text("{")
    run("reflectors", lit, dark, "--target", CLIENT, "--calibration",
        tmp_path / "bad.json").says("bad.json")  # fmt: skip
    assert not (tmp_path / "c").exists()
