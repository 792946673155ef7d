"""The documented block of commands: a whole approach to the client's ring, as it stands there."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.sequences import open_sequence

DOC = Path(__file__).resolve().parents[2] / "docs" / "fusion.md"
# A model as small as it can be: 42 views.
SMALL = [
    "--order", "0", "--views", "60", "--held-out", "0", "--resolution", "128", "--shells", "1,2",
    "--jobs", "1",
]  # fmt: skip


# One that finds far poses as well as the one of the documented command: 162 views.
MIDDLE = [
    "--order", "1", "--views", "60", "--held-out", "0", "--resolution", "200", "--shells",
    "1,2,4", "--jobs", "1",
]  # fmt: skip


RANGER_M = 0.02  # σ of the ranger of the other renderer's approach


def documented() -> list[list[str]]:
    """The commands of the block under the heading of the whole approach."""
    text = DOC.read_text(encoding="utf-8").split("## A whole approach")[1]
    block = text.split("```")[1].replace("\\\n", " ")
    return [shlex.split(line)[1:] for line in block.strip().splitlines()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("approach")


def test_the_documented_commands_fly_to_the_ring(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    commands = documented()
    assert [words[0] for words in commands] == [
        "train", "simulate", "track", "fuse", "ring", "fuse", "guide",
    ]  # fmt: skip
    for words in commands:
        small = {"train": SMALL, "simulate": ["--jobs", "1"]}.get(words[0], [])
        ran = run(*words, *small)
        assert ran.code == 0, ran.err
    ring = find_target("client").docking_ring
    truth = {
        frame.time_s: frame.camera_from_target for frame in open_sequence(folder / "scene").frames
    }
    near = []
    for line in (folder / "state.jsonl").read_text().splitlines():
        state = json.loads(line)
        if state["status"] != "tracking":
            continue
        pose = Pose.from_quat_wxyz(state["pose"]["quat_wxyz"], state["pose"]["translation_m"])
        true = truth[state["time_s"]]
        centre = true.apply(ring.centre_m)
        if np.linalg.norm(centre) < 6.5:
            near.append(np.linalg.norm(pose.apply(ring.centre_m) - centre))
    assert len(near) >= 8
    assert max(near) < 0.02  # 2 cm within the last six metres
    readings = [json.loads(line) for line in (folder / "ring.jsonl").read_text().splitlines()]
    assert sum(reading["status"] == "ok" for reading in readings) >= 3
    last = json.loads((folder / "guide.jsonl").read_text().splitlines()[-1])
    place = np.array(last["trajectory"]["segment"]["place_m"])
    assert place == pytest.approx([-3.0, 0.0, 0.0], abs=0.1)  # from the ring, along its axis
    assert "CCSDS_OEM_VERS" in (folder / "path.oem").read_text()
    echoes = [json.loads(line) for line in (folder / "laser.jsonl").read_text().splitlines()]
    assert len(echoes) == len(readings)
    assert all(echo["range_m"] is not None for echo in echoes)


def test_on_frames_of_another_renderer_the_fused_state_is_no_worse_than_the_recognizer(
    run, folder, monkeypatch
):
    data = os.environ.get("RENDEZVIEW_TEST_DATA")
    scene = Path(data or "") / "approach_mitsuba"
    if not data or not scene.is_dir():
        pytest.skip("approach_mitsuba is not here: set RENDEZVIEW_TEST_DATA to the test data")
    other = folder / "other_renderer"
    other.mkdir()
    monkeypatch.chdir(other)
    shutil.copy(scene / "laser.jsonl", ".")
    for words in documented():
        if words[0] == "simulate":
            continue
        places = [str(scene) if word == "scene" and words[0] != "track" else word for word in words]
        if words[0] == "track":  # its prior is the scene's, too
            places = [str(scene) if word == "scene" and k == 2 else word
                      for k, word in enumerate(words)]  # fmt: skip
        ran = run(*places, *(MIDDLE if words[0] == "train" else []))
        assert ran.code == 0, ran.err
    ring = find_target("client").docking_ring
    truth = {
        round(frame.time_s, 3): frame.camera_from_target for frame in open_sequence(scene).frames
    }

    def errors(name: str) -> dict[float, tuple[float, float]]:
        """Of the ring's centre, and the σ that the pose claims for its place."""
        found = {}
        for text in Path(name).read_text().splitlines():
            line = json.loads(text)
            true = truth.get(round(line["time_s"], 3))
            if line["pose"] is not None and true is not None:
                pose = Pose.from_quat_wxyz(**line["pose"])
                off = pose.apply(ring.centre_m) - true.apply(ring.centre_m)
                sigma_m = np.sqrt(np.trace(np.array(line["covariance"])[3:6, 3:6]))
                found[round(line["time_s"], 3)] = float(np.linalg.norm(off)), float(sigma_m)
        return found

    recognizer, fused = errors("track.jsonl"), errors("state.jsonl")
    ranges = {t: float(np.linalg.norm(pose.apply(ring.centre_m))) for t, pose in truth.items()}
    # Below 2 m, beside the ring alone, the recognizer knows no roll, and gives no pose.
    for far, near in ((30.0, 15.0), (15.0, 7.5), (7.5, 0.0)):
        times = [t for t in recognizer if near <= ranges[t] < far]
        assert len(times) >= 2
        (alone, claimed), (both, _) = (
            np.sqrt(np.mean([np.square(e[t]) for t in times], axis=0)) for e in (recognizer, fused)
        )
        if claimed > RANGER_M:  # then the ranger is the better one, as far as a filter can know
            alone = max(alone, RANGER_M)
        assert both <= 1.1 * alone + 1e-3, (far, near)
    states = [json.loads(line) for line in Path("state.jsonl").read_text().splitlines()]
    assert states[-1]["starts"] == 1
    assert {state["status"] for state in states[6:]} == {"tracking"}


def test_what_cannot_be_is_told_in_a_line(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    simulate = ["simulate", "client", "-o", "other", "--frames", "1"]
    run(*simulate, "--trajectory", "spiral", "--axis", "ring").says("--axis", "vbar")
    run(*simulate, "--trajectory", "vbar", "--axis", "1,2").says("--axis", "x,y,z")
    hubble = ["simulate", "hubble", "-o", "other", "--trajectory", "vbar", "--axis", "ring"]
    run(*hubble).says("docking_ring")
    noise = ["--trajectory", "vbar", "--laser", "l.jsonl", "--laser-sigma", "0"]
    run(*simulate, *noise).says("--laser-sigma")
    (folder / "odd.jsonl").write_text('{"time_s": 0.0, "pose": {"a": 1}, "covariance": [[1.0]]}\n')
    run("guide", "odd.jsonl", "--shape", "vbar", "-o", "g.jsonl").says("record 1")
    run("guide", "odd.jsonl", "-o", "g.jsonl").says("--plan", "--shape")
    hubble = ["--target", "hubble", "--shape", "vbar"]
    run("guide", "odd.jsonl", "-o", "g.jsonl", *hubble).says("docking_ring")
