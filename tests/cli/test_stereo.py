"""``rendezview stereo``: from a laboratory's record to poses, and what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests.plain_laboratory import write_record
from tests.processes import python

from rendezview.io.results import read_results
from rendezview.io.target import Target
from rendezview.sensors.beacons.rig_files import load_rig
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions

SCOLE = Path(__file__).resolve().parents[2] / "models_cad" / "scole"
RUN = "from rendezview.cli.main import main; main()"


@pytest.fixture(scope="module")
def laboratory() -> Laboratory:
    leds = np.array([led.position_m for led in Target.load(SCOLE).leds])
    return Laboratory(leds, LaboratoryOptions(signal_to_noise=1000.0), seed=71)


@pytest.fixture(scope="module")
def rig(laboratory: Laboratory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rig")
    write_record(laboratory.calibration(np.random.default_rng(71), scans=4), folder / "record.json")
    arguments = ["calibrate", "rig", folder / "record.json", "-o", folder / "rig.json"]
    done = python("-c", RUN, *arguments)
    assert done.returncode == 0, done.stderr
    assert "resection" in done.stderr
    return folder / "rig.json"


@pytest.mark.parametrize("options", [[], ["--filter"]])
def test_a_log_of_currents_gives_poses(
    run, laboratory, rig: Path, tmp_path: Path, options: list[str]
):
    poses = laboratory.stage(np.deg2rad(np.arange(0.0, 20.0, 2.0)))
    currents = laboratory.currents(poses, np.random.default_rng(1))
    currents[4] = np.nan
    lines = [
        {"time_s": 0.1 * k, "currents": [[None if np.isnan(x).any() else x.tolist() for x in camera]
                                         for camera in reading]}
        for k, reading in enumerate(currents)
    ]  # fmt: skip
    readings = tmp_path / "readings.jsonl"
    readings.write_text("\n".join(map(json.dumps, lines)))
    out, log = tmp_path / "poses.csv", tmp_path / "log.jsonl"
    done = run("stereo", "track", rig, "scole", readings, "-o", out, "--log", log, *options)
    assert done.code == 0, done
    records = [json.loads(line) for line in log.read_text().splitlines()]
    with out.open() as file:
        numbers = [int(row["im_id"]) for row in csv.DictReader(file)]
    expected = [k for k in range(10) if k != 4 or options]
    assert numbers == expected
    assert f"{len(expected)} poses in 10 readings" in done.err
    assert records[4]["status"] == ("partial" if options else "few-lights")
    assert "0 lights visible" in records[4]["reason"]
    first = load_rig(rig).cameras[0].camera_from_rig
    for row in read_results(out):
        truth = first @ poses[row.im_id]
        assert np.rad2deg(row.camera_from_target.angle_to(truth)) < 1.5
        yaw = records[row.im_id]["yaw_pitch_roll_rad"][0]
        assert np.rad2deg(yaw) == pytest.approx(2.0 * row.im_id, abs=0.5)
        assert np.shape(records[row.im_id]["covariance"]) == (6, 6)


def test_the_papers_normalisation_is_an_option_that_the_rig_file_keeps(
    run, rig: Path, tmp_path: Path
):
    usual = json.loads(rig.read_text())
    assert usual["cameras"][0]["photodiode"]["normalisation"] == "total"
    out = tmp_path / "pair.json"
    done = run("calibrate", "rig", rig.parent / "record.json", "-o", out, "--normalisation", "pair")
    assert done.code == 0, done
    pair = json.loads(out.read_text())
    assert {c["photodiode"]["normalisation"] for c in pair["cameras"]} == {"pair"}
    first, second = (x["cameras"][0]["photodiode"]["response"] for x in (pair, usual))
    assert first != second
    for one, other in zip(pair["cameras"], usual["cameras"], strict=True):
        assert one["fx"] == pytest.approx(other["fx"], rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("track NO SCOLE READINGS -o OUT", "no such file"),
        ("track RIG NO READINGS -o OUT", "no such target"),
        ("track RIG HUBBLE READINGS -o OUT", "needs at least 3"),
        ("track RIG SCOLE NO -o OUT", "no such file"),
        ("track RIG SCOLE RIG -o OUT", "different files"),
        ("track RIG SCOLE TRUNCATED -o OUT", "line 2"),
        ("track RIG SCOLE BACKWARDS -o OUT", "later than"),
        ("track RIG SCOLE ONE_CAMERA -o OUT", "2 cameras"),
        ("track RIG SCOLE FIVE -o OUT", "5 lights"),
        ("track RIG SCOLE EMPTY -o OUT", "no readings"),
        ("track RIG SCOLE READINGS -o NO/poses.csv", "existing folder"),
        ("track RIG SCOLE READINGS -o RIG", "different files"),
        ("track RIG SCOLE READINGS -o OUT --filter --angular nan", "--angular"),
        ("track RIG SCOLE FOLDER -o OUT", "pictures"),
        ("calibrate NO -o OUT", "no such file"),
        ("calibrate FOLDER -o OUT", "no numbered pictures"),
        ("calibrate FOLDER -o OUT --board 9", "--board"),
        ("calibrate FOLDER -o OUT --pitch-mm nan", "--pitch-mm"),
        ("calibrate FOLDER -o OUT --lens fisheye", "--lens"),
        ("calibrate RIG -o OUT", "missing, add it"),
        ("calibrate READINGS -o OUT", "JSON"),
        ("calibrate RIG -o NO/rig.json", "existing folder"),
    ],
)
def test_what_cannot_be_is_one_line_and_exit_1(
    run, rig: Path, tmp_path: Path, arguments: str, said: str
):
    (tmp_path / "FOLDER").mkdir()
    light = [[0.5] * 4] * 6
    line = {"time_s": 0.0, "currents": [light, light]}
    whole = json.dumps(line)
    files = {
        "READINGS": f"{whole}\n{json.dumps({**line, 'time_s': 1.0})}",
        "TRUNCATED": f"{whole}\n{whole[:-30]}",
        "BACKWARDS": f"{whole}\n{whole}",
        "ONE_CAMERA": json.dumps({"time_s": 0.0, "currents": [light]}),
        "FIVE": json.dumps({"time_s": 0.0, "currents": [light[:5], light[:5]]}),
        "EMPTY": "",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    places = {"RIG": rig, "SCOLE": SCOLE, "HUBBLE": SCOLE.parent / "hubble",
              "OUT": tmp_path / "out"}  # fmt: skip
    words = [
        places.get(w, tmp_path / w if w.split("/")[0].isupper() else w) for w in arguments.split()
    ]
    run("stereo", *words).says(said)
    assert not (tmp_path / "out").exists()
