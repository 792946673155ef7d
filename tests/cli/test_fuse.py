"""``rendezview fuse``: logs of several sensors into one state, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.io.results import JsonLinesWriter, read_json_lines
from rendezview.sensors.appearance.model.shape import Shape
from rendezview.sensors.measurement import tangents

SIGMA = np.array([4e-3, 4e-3, 2e-3, 0.01, 0.01, 0.05])
TARGET = """
name = "box"
[mesh]
path = "box.stl"
unit = "m"
[docking_ring]
centre_m = [-1.5, 0.0, 0.0]
axis = [-1.0, 0.0, 0.0]
radius_m = 0.6
"""
CENTRE, AXIS = np.array([-1.5, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])


def truth(time_s: float) -> Pose:
    rotation = Rotation.from_rotvec([0.0, -1.55, 0.0]).as_matrix()
    return Pose(rotation, np.array([0.2, -0.1, 25.0 - 0.2 * time_s]))


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """A folder with a target, and logs of a recognizer, a ring and a laser ranger."""
    rng = np.random.default_rng(4)
    (tmp_path / "box.toml").write_text(TARGET)
    (tmp_path / "box.stl").write_bytes(b"not read")
    tracks, rings, echoes = [], [], []
    for k in range(80):
        pose = truth(0.5 * k)
        head = {"image": f"{k}.png", "time_s": 0.5 * k}
        seen = pose.perturbed(SIGMA * rng.standard_normal(6))
        blind = k % 7 == 3
        tracks.append(
            {**head, "pose": None if blind else seen,
             "covariance": None if blind else np.diag(SIGMA**2)}
        )  # fmt: skip
        axis = pose.rotation @ AXIS + 2e-3 * rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        other = axis + 0.3 * tangents(axis)[:, 0]
        poses = [
            {
                "centre_m": pose.apply(CENTRE) + 5e-3 * rng.standard_normal(3),
                "axis": one / np.linalg.norm(one),
                "covariance": np.diag([5e-3**2] * 3 + [2e-3**2] * 2),
                "chosen": one is axis,
                "reason": "prior attitude",
            }
            for one in (other, axis)
        ]
        rings.append({**head, "ellipses": [], "poses": poses})
        normal = pose.rotation @ AXIS
        distance = normal @ pose.apply(CENTRE) / normal[2] + 0.02 * rng.standard_normal()
        echoes.append({"time_s": 0.5 * k, "range_m": distance, "sigma_m": 0.02})
    for name, records in (("track", tracks), ("ring", rings), ("laser", echoes)):
        with JsonLinesWriter(tmp_path / f"{name}.jsonl") as writer:
            for record in records:
                writer.write(record)
    return tmp_path


def fuse(run, logs: Path, *more: object, names=("track", "ring", "laser")):
    files = [logs / f"{name}.jsonl" for name in names]
    return run("fuse", *files, "--target", logs / "box.toml", "-o", logs / "state.jsonl", *more)


def test_three_logs_give_one_state_better_than_each(run, logs: Path):
    (logs / "options.json").write_text(
        json.dumps({"pose": {"lasting": 0.0}, "ring": {"lasting": 0.0}})
    )
    (logs / "surfaces.json").write_text(
        json.dumps([{"point_m": CENTRE.tolist(), "normal": AXIS.tolist(), "relief_m": 0.01}])
    )
    ran = fuse(run, logs, "--options", logs / "options.json", "--surfaces", logs / "surfaces.json")
    assert ran.code == 0, ran
    assert "track: 69 of 69 taken" in ran.err
    states = read_json_lines(logs / "state.jsonl")
    assert len(states) == 69 + 80 + 80
    last = states[-1]
    assert last["status"] == "tracking"
    off_m = np.array(last["pose"]["translation_m"]) - truth(39.5).translation_m
    assert np.abs(off_m).max() < 0.02
    assert last["rates"][5] == pytest.approx(-0.2, abs=0.01)
    covariance = np.array(last["covariance"])
    assert covariance.shape == (12, 12)
    assert np.sqrt(covariance[5, 5]) < 0.2 * SIGMA[5]
    assert set(last["sensors"]) == {"track", "ring", "laser"}


def test_a_range_can_be_cast_on_the_mesh_of_a_model(run, logs: Path, tiny_model):
    model = logs / "model.rvm"
    # A wall in the ring's plane, in which the drawn ranger meets the target.
    sides = 50.0 * tangents(AXIS).T
    corners = CENTRE - tiny_model.centre_m + np.array([*sides, -sides.sum(axis=0)])
    wall = Shape(
        corners.astype(np.float32), np.array([[0, 1, 2]], np.int32), np.zeros(1, np.uint8),
        np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0),
    )  # fmt: skip
    replace(tiny_model, shape=wall).save(model)
    ran = fuse(run, logs, "--model", model)
    assert ran.code == 0, ran
    ranges = [
        state["measurement"]
        for state in read_json_lines(logs / "state.jsonl")
        if state["measurement"]["sensor"] == "laser"
    ]
    assert ranges[0]["reason"] == "a range on the mesh waits until poses agree"
    assert all(one["accepted"] for one in ranges[5:])
    tiny_model.save(model)
    fuse(run, logs, "--model", model).says("carries no mesh", "--surfaces")


def test_estimates_can_be_asked_for_between_measurements(run, logs: Path):
    assert fuse(run, logs, "--every-s", "0.2", names=("track",)).code == 0
    states = read_json_lines(logs / "state.jsonl")
    assert sum(state["measurement"] is None for state in states) > 150


def test_an_interval_of_too_many_estimates_is_refused(run, logs: Path):
    for every_s in ("1e-9", "1e-300"):  # with the latter no time would pass
        fuse(run, logs, "--every-s", every_s, names=("track",)).says("--every-s", "1,000,000")


def test_names_and_mounts_are_those_given(run, logs: Path):
    (logs / "mount.json").write_text(
        json.dumps({"quat_wxyz": [1.0, 0.0, 0.0, 0.0], "translation_m": [0.5, 0.0, 0.0]})
    )
    ran = run("fuse", f"eye={logs / 'track.jsonl'}", "--mount", f"eye={logs / 'mount.json'}",
              "-o", logs / "state.jsonl")  # fmt: skip
    assert ran.code == 0, ran
    last = read_json_lines(logs / "state.jsonl")[-1]
    assert last["measurement"]["sensor"] == "eye"
    x = last["pose"]["translation_m"][0]
    assert x == pytest.approx(0.2 - 0.5, abs=0.05)


def test_what_cannot_be_joined_is_told_in_one_line(run, logs: Path):
    state = logs / "state.jsonl"
    run("fuse", logs / "none.jsonl", "-o", state).says("no such file")
    run("fuse", logs / "ring.jsonl", "-o", state).says("docking ring")
    run("fuse", logs / "laser.jsonl", "-o", state).says("--target")
    twice = (logs / "track.jsonl", logs / "track.jsonl")
    run("fuse", *twice, "-o", state).says("one sensor")
    run("fuse", logs / "track.jsonl", "-o", logs / "track.jsonl").says("overwrite")
    run("fuse", logs / "track.jsonl", "--mount", "eye=x.json", "-o", state).says("--mount")
    (logs / "empty.jsonl").write_text("")
    run("fuse", logs / "empty.jsonl", "-o", state).says("no lines")
    (logs / "other.jsonl").write_text('{"a": 1}\n')
    run("fuse", logs / "other.jsonl", "-o", state).says("no log of a sensor")
    (logs / "options.json").write_text('{"pose": {"lastign": 0.1}}')
    fuse(run, logs, "--options", logs / "options.json").says("lastign")
    (logs / "surfaces.json").write_text('[{"point_m": [0, 0]}]')
    fuse(run, logs, "--surfaces", logs / "surfaces.json").says("surfaces.json", "normal")
    assert not state.exists()
    assert not (logs / "state.jsonl.partial").exists()


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ({"pose": {"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 9]}, "covariance": [[1]],
          "time_s": 0.0}, "covariance"),
        ({"pose": {"quat_wxyz": [0, 0, 0, 0], "translation_m": [0, 0, 9]}, "covariance": [[1]],
          "time_s": 0.0}, "quat"),
        ({"pose": {"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 9]},
          "covariance": np.eye(6).tolist(), "time_s": None}, "time_s"),
        ({"range_m": -2.0, "sigma_m": 0.1, "time_s": 0.0}, "positive"),
        ({"range_m": 2.0, "time_s": 0.0}, "sigma_m"),
        ({"ellipses": [], "poses": [{"centre_m": [0, 0, 9], "axis": [0, 0, 1]}], "time_s": 0.0},
         "covariance"),
        ({"range_m": 2.0, "sigma_m": "0.1", "time_s": 0.0}, "sigma_m: input should be"),
        ({"range_m": True, "sigma_m": 0.1, "time_s": 0.0}, "range_m: input should be"),
        ({"range_m": 2.0, "sigma_m": 0.1, "time_s": 1e308}, "time_s must be within"),
        ({"range_m": 2.0, "sigma_m": 1e-12, "time_s": 0.0}, "variances must be"),
        ({"range_m": 2.0, "sigma_m": 0.1, "time_s": 0.0, "direction": [0, 0, -1e308]}, "direction"),
        ({"rate_rad_s": [0, "1", 0], "sigma_rad_s": 1e-3, "time_s": 0.0}, "rate_rad_s.1"),
        ({"velocity_change_m_s": [1e10, 0, 0], "sigma_m_s": 0.1, "time_s": 0.0}, "within 100000"),
        ({"pose": {"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, "9"]},
          "covariance": np.eye(6).tolist(), "time_s": 0.0}, "pose.translation_m.2"),
        ({"pose": {"quat_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 9]},
          "covariance": np.triu(np.full((6, 6), 0.1) + np.eye(6)).tolist(), "time_s": 0.0},
         "symmetric"),
    ],
)  # fmt: skip
def test_a_wrong_line_is_named(run, logs: Path, line, word):
    (logs / "wrong.jsonl").write_text(json.dumps(line) + "\n")
    ran = run("fuse", logs / "wrong.jsonl", "--target", logs / "box.toml", "-o",
              logs / "state.jsonl")  # fmt: skip
    ran.says("record 1", word)


def test_a_line_that_is_there_twice_is_named(run, logs: Path):
    for name in ("track", "ring", "laser"):
        path = logs / f"{name}.jsonl"
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:9], lines[1], *lines[9:]]) + "\n")
        fuse(run, logs, names=(name,)).says(path.name, "record 10", "after record 2")


def test_two_beams_may_read_at_one_time(run, logs: Path):
    path = logs / "laser.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    both = [{**line, "origin_m": [x, 0.0, 0.0]} for line in lines for x in (-0.1, 0.1)]
    path.write_text("".join(f"{json.dumps(line)}\n" for line in both))
    ran = fuse(run, logs, names=("track", "laser"))
    assert ran.code == 0, ran
    assert "laser: 160 of 160 taken" in ran.err


def test_options_of_an_older_version_are_said_to_be_ignored(run, logs):
    options = logs / "options.json"
    options.write_text('{"motion": {"linear": 0.01}, "pose": {"gate": 0.001}}')
    ran = run("fuse", logs / "track.jsonl", "--options", options, "-o", logs / "state.jsonl")
    assert ran.code == 0, ran.err
    said = " ".join(ran.err.split())
    assert "linear of earlier versions are ignored" in said
    assert "gate of earlier versions are ignored" in said


def test_options_of_a_sensor_without_a_log_are_said_to_be_ignored(run, logs):
    options = logs / "options.json"
    options.write_text('{"sensors": {"trakc": {"inflation": 2.0}}}')
    ran = run("fuse", logs / "track.jsonl", "--options", options, "-o", logs / "state.jsonl")
    assert ran.code == 0, ran.err
    assert "sensors.trakc is ignored: no log has this name (track)" in " ".join(ran.err.split())
