"""`rendezview calibrate ring`: a ring of unknown size from a fly-around and a ranger's log."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.sensors.ring.flyaround import (
    DISTANCE_M,
    PANEL_M,
    RADIUS_M,
    WIDTH_M,
    camera_at,
    draw,
    plane_range,
)

from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera

OFFSET_M = (0.05, -0.03)  # of the ring's axis from the panel's middle
SIGMA_M = 0.005
WRONG = 2  # the frame whose echo is of another surface


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames at 12 m, one with a wrong range, one without a panel."""
    folder = tmp_path_factory.mktemp("flyaround")
    camera = Camera.from_fov(512, 512, math.radians(42.0))
    save_camera(camera, folder / "camera.yaml")
    rng = np.random.default_rng(5)
    lines = []
    angles = [-0.9, -0.75, -0.6, -0.45, 0.5, 0.65, 0.8, 0.95]
    for k, angle in enumerate(angles):
        pose = camera_at(angle)
        cv2.imwrite(str(folder / f"{k:03d}.png"), draw(camera, pose, rng, OFFSET_M))
        range_m = plane_range(pose) + rng.normal(0.0, SIGMA_M) - 0.5 * (k == WRONG)
        lines.append({"im_id": k, "range_m": range_m, "sigma_m": SIGMA_M})
    cv2.imwrite(str(folder / "008.png"), np.full((512, 512), 30, np.uint8))
    lines.append({"im_id": 8, "range_m": 12.0, "sigma_m": SIGMA_M})
    (folder / "laser.jsonl").write_text("\n".join(json.dumps(line) for line in lines))
    return folder


def test_the_diameter_is_measured_within_its_uncertainty(run, flight, tmp_path):
    output, log = tmp_path / "size.json", tmp_path / "log.jsonl"
    ran = run("calibrate", "ring", flight, "--ranges", flight / "laser.jsonl", "-o", output,
              "--log", log)  # fmt: skip
    assert ran.code == 0, ran
    found = json.loads(output.read_text())
    assert (found["status"], found["frames"], found["measured"]) == ("ok", 9, 8)
    assert found["used"] == 7  # the wrong range is found by its misfit
    assert found["diameter_m"] == pytest.approx(2.0 * RADIUS_M, rel=0.005)
    for name, true in (("diameter", 2.0 * RADIUS_M), ("distance", DISTANCE_M)):
        error = abs(found[f"{name}_m"] - true)
        assert error < 4.0 * found[f"{name}_sigma_m"] < 0.02 * true
    assert np.abs(np.subtract(found["offset_m"], OFFSET_M)).max() < 0.005
    np.testing.assert_allclose(found["panel_m"], PANEL_M, rtol=0.005)
    outer, inner = found["circles"][:2]
    assert outer["radius_m"] == pytest.approx(RADIUS_M, rel=0.01)
    assert inner["radius_m"] == pytest.approx(RADIUS_M - WIDTH_M, rel=0.01)
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(records) == 9
    assert "no panel" in records[8]["reason"]
    assert records[0]["reason"] is None
    assert "diameter 1.19" in ran.err


def test_what_cannot_be_measured_is_one_line(run, flight, tmp_path):
    lines = (flight / "laser.jsonl").read_text().splitlines()
    few = tmp_path / "few.jsonl"
    few.write_text("\n".join(lines[:2]))
    ran = run("calibrate", "ring", flight, "--ranges", few)
    ran.says("2 frames with a panel, a range and an ellipse", "3 are needed")
    assert json.loads(ran.out)["status"] == "not found"
    bad = tmp_path / "bad.jsonl"
    for text, said in (
        ('{"im_id": 0, "range_m": 12.0}', "sigma_m"),
        ('{"im_id": 0, "range_m": -1.0, "sigma_m": 0.1}', "positive"),
        ('{"range_m": 12.0, "sigma_m": 0.1}', "time_s"),
    ):
        bad.write_text(text)
        run("calibrate", "ring", flight, "--ranges", bad).says("record 1", said)
    run("calibrate", "ring", flight, "--ranges", tmp_path / "none.jsonl").says("none.jsonl")
    assert run("calibrate", "ring", flight).code == 2
    run("ring", "size", flight, "--ranges", bad).says("record 1")  # its name until version 0.4
