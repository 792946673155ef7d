"""The same command with ports that a plan gives: a bundled craft's fitting, a stranger's mesh."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import pytest

from rendezview.cli.main import main
from rendezview.io.bundled import find_target

# 3 m before the port, to be short.
SHORT = """
[port]
centre_m = {centre}
axis = {axis}
{radius}
[chaser]
start_m = 3.0
place_sigma_m = 0.02
[guidance]
holds_m = [2.0]
longest_s = 150.0
"""


def fly(monkeypatch, capsys, folder: Path, target: str, *more: str, **port: object) -> str:
    plan = folder / "plan.toml"
    plan.write_text(SHORT.format(**port))
    words = ["rendezview", "fly", target, "--plan", str(plan), "-o", str(folder / "flight"), *more]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert ended.value.code == 0, said.err
    assert (folder / "flight" / "flight.html").stat().st_size > 10_000
    return said.out


def test_hubbles_berthing_pin_is_reached_by_the_same_command(monkeypatch, capsys, tmp_path):
    angle = math.radians(90.0)  # the first of the three pins of the service cradle: build.py
    pin = [-6.9, round(1.8 * math.cos(angle), 6), round(1.8 * math.sin(angle), 6)]
    said = fly(
        monkeypatch, capsys, tmp_path, "hubble", centre=pin, axis=[-1.0, 0.0, 0.0], radius=""
    )
    assert said.startswith("contact")


def test_a_strangers_mesh_with_a_ring_that_the_plan_places(monkeypatch, capsys, tmp_path):
    mesh = Path(os.environ.get("RENDEZVIEW_TEST_DATA", "")) / "meshes_42" / "Kepler.obj"
    if not mesh.exists():
        pytest.skip("RENDEZVIEW_TEST_DATA does not name a folder with meshes_42")
    place = {"centre": [-2.093, -0.408, 0.0], "axis": [-1.0, 0.0, 0.0], "radius": "radius_m = 0.4"}
    said = fly(monkeypatch, capsys, tmp_path, str(mesh), "--unit", "m", **place)
    assert said.startswith("contact")


def test_lights_that_give_no_pose_are_an_error_before_anything_is_flown(
    monkeypatch, capsys, tmp_path
):
    lines = (find_target("scole").mesh_path.parent / "target.toml").read_text().split("[[leds]]")
    target = tmp_path / "target.toml"
    mesh = find_target("scole").mesh_path
    target.write_text("[[leds]]".join(lines[:3]).replace('"scole.glb"', f'"{mesh}"'))
    plan = tmp_path / "plan.toml"
    plan.write_text("[port]\ncentre_m = [0.3, 0, -0.03]\naxis = [0, 0, -1]\n")
    words = ["rendezview", "fly", str(target), "--plan", str(plan), "-o", str(tmp_path / "flight")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code != 0
    assert "has 2 lights, a pose needs at least 3" in capsys.readouterr().err
    assert not (tmp_path / "flight").exists()
