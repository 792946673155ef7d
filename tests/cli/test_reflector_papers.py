"""`rendezview reflectors`: what the papers name besides the pose, each as an option."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.reflector_runs import CAMERA, CLIENT, write_run

from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import save_camera
from rendezview.io.target import Target
from rendezview.sensors.beacons import SixNumbers, patterns_of, pose_of

FAR = patterns_of(Target.load(CLIENT), ("far",))[0]
STEP_S = 0.25


def approach(t: float) -> SixNumbers:
    return SixNumbers(4.0 - 0.2 * t, 0.03, -0.02, 0.1 + 0.05 * t, 0.15 * np.sin(t), 0.2 * np.cos(t))


def write(folder: Path, sixes: list[SixNumbers], mount: Pose | None = None, seed: int = 0) -> None:
    """Scenes lit and dark of a run; ``mount``: camera from chaser."""
    poses = ((mount or Pose.identity()) @ pose_of(six, FAR) for six in sixes)
    write_run(folder, FAR, poses, seed=seed, step_s=STEP_S)


@pytest.fixture(scope="module")
def tracked_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("papers")
    write(folder, [approach(STEP_S * k) for k in range(16)])
    return folder


def readings(run, folder: Path, log: Path, *options: object) -> list[dict]:
    ran = run("reflectors", folder / "lit", folder / "dark", "--target", CLIENT, "--group", "far",
              "-o", log, *options)  # fmt: skip
    assert ran.code == 0, ran
    return [json.loads(line) for line in log.read_text().splitlines()]


@pytest.mark.parametrize(("method", "tilt"), [("newton", 0.002), ("alternate", 0.01)])
def test_bales_iterations_give_six_numbers_and_their_rates(
    run, tracked_run, tmp_path, method, tilt
):
    lines = readings(run, tracked_run, tmp_path / "log.jsonl", "--triangulation", method)
    assert lines[0]["triangulation"] is None  # found for the first time: no pose yet
    found = [line["triangulation"] for line in lines[1:]]
    assert all(one["converged"] for one in found)
    assert set(found[0]["distances_m"]) == {"far-left", "far-middle", "far-right"}
    for line, one in zip(lines[1:], found, strict=True):
        assert one["six"]["range_m"] == pytest.approx(line["six"]["range_m"], rel=0.003)
        for angle in ("roll_rad", "pitch_rad", "yaw_rad"):
            assert one["six"][angle] == pytest.approx(line["six"][angle], abs=tilt)
    assert found[-1]["rates"]["six_per_s"][0] == pytest.approx(-0.2, abs=0.05)
    assert found[0]["rates"] is None


def test_the_printed_hourglass_and_every_centroid_find_the_same_target(run, tracked_run, tmp_path):
    usual = readings(run, tracked_run, tmp_path / "usual.jsonl")
    options = (["--hourglass", "paper"], ["--centroid", "weighted"], ["--centroid", "binary"])
    spread = []
    for number, option in enumerate(options):
        lines = readings(run, tracked_run, tmp_path / f"{number}.jsonl", *option)
        off = [
            abs(line["six"]["range_m"] / other["six"]["range_m"] - 1.0)
            for line, other in zip(lines, usual, strict=True) if other["six"] is not None
        ]  # fmt: skip
        assert len(off) == 15
        assert max(off) < 0.01
        spread.append(float(np.mean(off)))
    assert spread[0] == 0.0  # which triplets pass changes nothing in a pose
    assert 0.0 < spread[1] < spread[2]  # the binary centroid is the coarsest


def test_the_printed_hourglass_is_refused_where_no_post_stands_midway(run, tracked_run, tmp_path):
    corner = tmp_path / "corner.toml"
    corner.write_text(
        'name = "corner"\ndescription = "three at a right angle"\n'
        + "".join(
            f'[[reflectors]]\nname = "{n}"\ngroup = "g"\nposition_m = {p}\n'
            "normal = [0.0, 0.0, 1.0]\ndiameter_m = 0.02\n"
            for n, p in (("a", [0.0, 0.0, 0.0]), ("b", [0.4, 0.0, 0.0]), ("c", [0.0, 0.3, 0.0]))
        )
    )
    run("reflectors", tracked_run / "lit", tracked_run / "dark", "--target", corner,
        "--hourglass", "paper").says("post midway")  # fmt: skip


def test_separate_known_poses_calibrate(run, tmp_path):
    rng = np.random.default_rng(5)
    write(tmp_path / "poses", [
        SixNumbers(rng.uniform(1.5, 8.0), *rng.uniform(-0.15, 0.15, 2), rng.uniform(-1.5, 1.5),
                   *rng.uniform(-0.35, 0.35, 2))
        for _ in range(24)
    ])  # fmt: skip
    out = tmp_path / "c.json"
    for option in ([], ["--independent"]):
        folders = tmp_path / "poses" / "lit", tmp_path / "poses" / "dark"
        ran = run("reflectors", "calibrate", *folders, "--target", CLIENT, "--group", "far",
                  "-o", out, *option)  # fmt: skip
        assert ran.code == 0, ran
        used = int(ran.err.split(" from ")[1].split(" of ")[0])
        assert used >= 22
        assert json.loads(out.read_text())["yaw_slope"] == pytest.approx(1.0, abs=0.15)


def test_an_acceleration_that_is_known_moves_the_windows(run, tmp_path):
    """A push between two readings moves the target by 0.55 m: the last motion does not tell."""
    sixes, bearing, rate = [], -0.1, 0.0
    for k in range(10):
        sixes.append(SixNumbers(4.0, bearing, 0.0, 0.1, 0.1, 0.1))
        rate += 0.0 if k != 5 else 0.55  # rad/s of the azimuth, from here on
        bearing += rate * STEP_S
    write(tmp_path / "run", sixes)
    without = readings(run, tmp_path / "run", tmp_path / "without.jsonl")
    assert without[6]["tracked"] is False or without[6]["pose"] is None
    # The windows move by half of step times two steps times the acceleration: 0.55 m.
    push = 4.0 * 0.55 / STEP_S
    known = tmp_path / "known.jsonl"
    known.write_text("".join(
        json.dumps({"time_s": STEP_S * k, "angular_rad_s2": [0.0, 0.0, 0.0],
                    "linear_m_s2": [push if k == 6 else 0.0, 0.0, 0.0]}) + "\n"
        for k in range(10)
    ))  # fmt: skip
    aided = readings(run, tmp_path / "run", tmp_path / "aided.jsonl", "--accelerations", known)
    assert aided[6]["tracked"] is True
    assert aided[6]["status"] == "ok"
    known.write_text('{"time_s": 0, "linear_m_s2": [0, 0, 0]}\n')
    run("reflectors", tmp_path / "run" / "lit", tmp_path / "run" / "dark", "--target", CLIENT,
        "--accelerations", known).says("angular_rad_s2")  # fmt: skip


def test_several_cameras_switch_over_and_fall_back_when_one_fails(run, tmp_path):
    mount = Pose(np.eye(3), np.array([0.05, 0.0, 0.0]))
    sixes = [approach(STEP_S * k) for k in range(16)]  # 4 m to 3.2 m
    write(tmp_path / "wide", sixes, seed=1)
    write(tmp_path / "long", sixes, mount, seed=2)
    save_camera(CAMERA, tmp_path / "camera.yaml")
    (tmp_path / "long" / "lit" / "gray" / "000004.png").write_bytes(b"no picture")
    cameras = tmp_path / "cameras.toml"
    cameras.write_text(
        """
[[cameras]]
name = "wide"
camera = "camera.yaml"
frames = ["wide/lit", "wide/dark"]
nearest_m = 0.5
farthest_m = 3.6

[[cameras]]
name = "long"
frames = ["long/lit", "long/dark"]
nearest_m = 3.4
farthest_m = 50.0
camera_from_chaser = { quat_wxyz = [1.0, 0.0, 0.0, 0.0], translation_m = [0.05, 0.0, 0.0] }
"""
    )
    log = tmp_path / "log.jsonl"
    ran = run("reflectors", CLIENT, "--cameras", cameras, "--group", "far", "-o", log)
    assert ran.code == 0, ran
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["camera"] for line in lines[:5]] == ["long"] * 4 + ["wide"]
    assert "long" in lines[4]["note"]
    assert lines[-1]["camera"] == "wide"
    for k, line in enumerate(lines[1:], start=1):
        assert line["status"] == "ok", (k, line["reason"])
        truth = pose_of(sixes[k], FAR)
        assert line["chaser_from_target"]["translation_m"] == pytest.approx(
            truth.translation_m, abs=0.01
        )
    cameras.write_text('[[cameras]]\nname = "x"\nframes = ["wide/lit"]\nnearest_m = 1.0\n')
    run("reflectors", CLIENT, "--cameras", cameras).says("cameras.0.farthest_m")
    run("reflectors", CLIENT, tmp_path / "wide" / "lit", "--cameras", cameras).says("leave out")


def test_each_reading_suggests_an_exposure(run, tmp_path):
    poses = [pose_of(SixNumbers(3.0, 0.0, 0.0, 0.1, 0.1, 0.1), FAR)] * 6
    peaks_grey = (60.0, 60.0, 180.0, 180.0, 600.0, 600.0)
    write_run(tmp_path, FAR, poses, seed=3, step_s=1.0, peaks_grey=peaks_grey)
    lines = readings(run, tmp_path, tmp_path / "log.jsonl")
    factors = [line["exposure_factor"] for line in lines]
    assert factors[1] == pytest.approx(3.0, rel=0.15)
    assert factors[2:4] == [1.0, 1.0]
    assert factors[4:] == [0.5, 0.5]
