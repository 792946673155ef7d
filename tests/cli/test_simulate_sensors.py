"""``rendezview simulate``: pictures for the reflector sensor and for the stereo tracker."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rendezview.io.results import read_results
from rendezview.io.target import Target
from rendezview.sensors.beacons.rig_files import load_rig, save_rig
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions, picture_rig

MODELS = Path(__file__).resolve().parents[2] / "models_cad"
CLIENT, SCOLE = MODELS / "client", MODELS / "scole"


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_reflectors_of_a_vehicle_are_simulated_and_read(run, tmp_path):
    ran = run("simulate", CLIENT, "-o", tmp_path / "run", "--trajectory", "vbar", "--axis", "ring",
              "--reflectors", "--frames", 6, "--dt", 0.5, "--start-range", 6, "--end-range", 5,
              "--overexposure", 0.3, "--noise", 2, "--jitter", 0, "--jobs", 1)  # fmt: skip
    assert ran.code == 0, ran
    lit, dark = (
        cv2.imread(str(tmp_path / "run" / name / "gray" / "000003.png"), 0).astype(int)
        for name in ("lit", "dark")
    )
    assert (lit - dark).max() > 100  # the reflectors
    assert np.median(np.abs(lit - dark)) < 6  # the vehicle is in both, with noise of its own
    assert dark.max() > 40
    assert (lit != dark).mean() > 0.5
    log = tmp_path / "log.jsonl"
    ran = run("reflectors", tmp_path / "run" / "lit", tmp_path / "run" / "dark", "--target", CLIENT,
              "-o", log)  # fmt: skip
    assert ran.code == 0, ran
    truth = json.loads((tmp_path / "run" / "lit" / "scene_gt.json").read_text())
    found = [line for line in lines(log) if line["status"] == "ok"]
    assert len(found) >= 4
    for line in found:
        at = np.array(truth[str(line["im_id"])][0]["cam_t_m2c"]) / 1e3
        assert line["pose"]["translation_m"] == pytest.approx(at, abs=0.03)


@pytest.mark.parametrize(
    ("integration", "least", "most"),
    [("automatic", 140, 254), ("fixed", 255, 255), ("suggested", 60, 254)],
)
def test_the_exposure_follows_the_reflectors(run, tmp_path, integration, least, most):
    card = tmp_path / "card"
    assert run("calibrate", "card", "-o", card).code == 0
    ran = run("simulate", card / "target.toml", "-o", tmp_path / "run", "--trajectory", "vbar",
              "--axis", "0,0,1", "--reflectors", "--frames", 12, "--dt", 0.5, "--start-range", 3.0,
              "--end-range", 0.8, "--integration", integration, "--jitter", 0, "--jobs", 1,
              "--noise", 2)  # fmt: skip
    assert ran.code == 0, ran
    last = cv2.imread(str(tmp_path / "run" / "lit" / "gray" / "000011.png"), 0)
    assert least <= int(last.max()) <= most
    exposures = [line["exposure"] for line in lines(tmp_path / "run" / "integration.jsonl")]
    assert exposures[0] == 1.0
    if integration != "fixed":
        assert exposures[-1] < 0.3


def test_lights_are_simulated_and_tracked_in_pictures_and_currents(run, tmp_path):
    leds = np.array([led.position_m for led in Target.load(SCOLE).leds])
    laboratory = Laboratory(leds, LaboratoryOptions(distorted=False), seed=1)
    save_rig(picture_rig(laboratory, PictureOptions(size_px=640)), tmp_path / "pictures.json")
    save_rig(laboratory.rig, tmp_path / "diodes.json")
    common = ["--trajectory", "vbar", "--axis", "0,0,-1", "--frames", 6, "--dt", 0.2,
              "--start-range", 7.8, "--end-range", 7.6, "--jitter", 0, "--noise", 1]  # fmt: skip
    cases = {
        "pictures": ("pictures.json", [], ["--rate", 5], 0.02),
        "spots": ("pictures.json", ["--multiplex-s", 0.01], ["--multiplex-s", 0.01], 0.02),
        "currents": ("diodes.json", [], [], 0.06),
    }
    for name, (rig, options, tracking, within) in cases.items():
        folder, out = tmp_path / name, tmp_path / f"{name}.csv"
        ran = run("simulate", SCOLE, "-o", folder, *common, "--leds", tmp_path / rig, *options)
        assert ran.code == 0, ran
        source = folder if name == "pictures" else folder / "readings.jsonl"
        ran = run("stereo", "track", tmp_path / rig, SCOLE, source, "-o", out, *tracking)
        assert ran.code == 0, ran
        truth = {
            line["im_id"]: line["camera_from_target"] for line in lines(folder / "truth.jsonl")
        }
        rows = read_results(out)
        assert len(rows) >= 5, name
        for row in rows:
            at = truth[row.im_id]["translation_m"]
            assert row.camera_from_target.translation_m == pytest.approx(at, abs=within), name
    assert (tmp_path / "pictures" / "left" / "000000.png").is_file()
    assert load_rig(tmp_path / "diodes.json").cameras[0].photodiode is not None


def test_what_cannot_be_simulated_is_told(run, tmp_path):
    words = ["-o", tmp_path / "x", "--trajectory", "circular", "--frames", 1]
    run("simulate", SCOLE, *words, "--reflectors").says("no reflectors")
    run("simulate", CLIENT, *words, "--reflectors", "--leds", "x").says("not both")
