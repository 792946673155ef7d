"""The commands one after another, as a person would use them for the first time."""

from __future__ import annotations

import csv
import json
import os
import re
from pathlib import Path

import cv2
import pytest
from tests.processes import python

from rendezview.cli import main

TINY = ["--order", "1", "--views", "300", "--held-out", "50", "--resolution", "96", "--jobs", "1"]
COMMANDS = ("demo", "train", "simulate", "track", "evaluate", "show", "export")


@pytest.mark.requirement("RV-CMD-2")
def test_from_a_mesh_to_an_evaluation(run, mesh_path: Path, tmp_path: Path):
    model, scene = tmp_path / "bumpy.rvm", tmp_path / "scene"
    poses, log = tmp_path / "poses.csv", tmp_path / "log.jsonl"

    ran = run("train", mesh_path, "-o", model, *TINY)
    assert ran.code == 0
    assert "taken as metres" in ran.err  # the guess of the unit is said
    assert "━" not in ran.err  # no bar where stderr is no terminal
    assert list(tmp_path.iterdir()) == [model]

    ran = run("simulate", mesh_path, "-o", scene, "--trajectory", "circular", "--frames", 5,
              "--start-range", 12, "--masks", "--jobs", 1)  # fmt: skip
    assert (ran.code, ran.err) == (0, f"{scene}: 5 frames\n")
    for kind in ("gray", "mask_visib"):
        assert len(list((scene / kind).glob("*.png"))) == 5
    assert len(json.loads((scene / "scene_gt.json").read_text())) == 5

    ran = run("track", model, scene, "-o", poses, "--log", log, "--prior", "scene")
    assert ran.code == 0
    assert ran.err.count("\n") == 1
    assert " poses in 5 frames" in ran.err
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [r["im_id"] for r in records] == [0, 1, 2, 3, 4]
    rows = list(csv.DictReader(poses.read_text().splitlines()))
    assert [int(row["im_id"]) for row in rows] == [
        r["im_id"] for r in records if r["pose"] is not None
    ]
    assert all((r["pose"] is None) == (r["reason"] is not None) for r in records)

    ran = run("evaluate", scene, poses)
    assert ran.code == 0
    assert f"5 frames, {len(rows)} with a pose" in ran.out
    ran = run("evaluate", scene, poses, "--target", mesh_path, "--json")
    report = json.loads(ran.out)
    assert (report["frames"], report["found"]) == (5, len(rows))
    assert len(report["missing"]) == 5 - len(rows)

    for what, names in (
        (model, {"model.png", "nodes.csv"}),
        (scene, {"frames.png"}),
        (log, {"track.png", "curves.png", "cloud.png"}),
    ):
        folder = tmp_path / f"{what.stem}-shown"
        ran = run("show", what, "-o", folder)
        assert ran.code == 0
        assert {path.name for path in folder.iterdir()} == names
        for picture in folder.glob("*.png"):
            assert cv2.imread(str(picture)).std() > 1.0
            assert str(picture) in ran.err.splitlines()  # whole, however long the path is
    assert len((tmp_path / "bumpy-shown" / "nodes.csv").read_text().splitlines()) == 1 + 42

    ran = run("export", model, "--listing", "--node", 3)
    assert ran.out.startswith("Node 3  direction ")
    assert ran.out.count("Node") == 1
    ran = run("export", model, "--rules", "-o", tmp_path / "rules.txt")
    assert (ran.code, ran.out) == (0, "")
    assert (tmp_path / "rules.txt").read_text().count("Node ") == 42


@pytest.mark.parametrize("how", ["quaternion", "file", "independent"])
def test_ways_to_start_a_track(
    run, tiny_model_path: Path, scene: Path, prior_path: Path, tmp_path: Path, how: str
):
    quaternion = ",".join(map(str, json.loads(prior_path.read_text())["quat_wxyz"]))
    options = {
        "quaternion": ["--prior", quaternion],
        "file": ["--prior", prior_path],
        "independent": ["--independent"],
    }[how]
    log = tmp_path / "log.jsonl"
    ran = run("track", tiny_model_path, scene, "-o", tmp_path / "p.csv", "--log", log, *options)
    assert ran.code == 0
    statuses = [json.loads(line)["status"] for line in log.read_text().splitlines()]
    assert len(statuses) == 9
    assert set(statuses) <= {"ok", "ambiguous", "unrecognized"}
    if how != "independent":
        assert statuses[0] == "ok"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_in_one_line_that_names_real_options(run, command: str):
    ran = run(command, "--help")
    assert (ran.code, ran.err) == (0, "")
    assert run(command, "-h").out == ran.out
    (example,) = [line for line in ran.out.splitlines() if "Example:" in line]
    words = example.split()
    assert words[1:3] == ["rendezview", command]
    for option in (word for word in words if word.startswith("-")):
        assert option in ran.out.split("Options:")[1]


def test_a_command_of_another_package_joins_the_help_and_runs(run, monkeypatch, tmp_path):
    (tmp_path / "greeting.py").write_text(
        "def greet(name: str) -> None:\n    print('hello', name)\n"
    )
    package = tmp_path / "greeting-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: greeting\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[rendezview.commands]\ngreet = greeting:greet\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run("greet", "you").out == "hello you\n"
    assert "greet       A command of greeting." in run("--help").out


def test_the_help_has_every_command_on_a_line_that_is_not_cut(run):
    for option in ("-h", "--help"):
        commands = run(option).out.split("Commands:")[1]
        lines = [line.split() for line in commands.splitlines()]
        assert set(main._SUMMARIES) <= {words[0] for words in lines if len(words) > 3}
        assert "..." not in commands


@pytest.mark.parametrize("command", main._MAIN_OPTIONS)
def test_a_long_help_shows_the_main_options_and_help_all_every_one(run, command: str):
    def options(out: str) -> list[str]:
        return re.findall(r"^  (?:-\w, )?(--[\w-]+)", out.split("Options:")[1], re.MULTILINE)

    brief, every = run(command, "--help"), run(command, "--help-all")
    assert (brief.code, every.code) == (0, 0)
    few, all_of_them = options(brief.out), options(every.out)
    assert len(few) == len(main._MAIN_OPTIONS[command]) + 1  # and --help
    assert set(few) < set(all_of_them)
    assert f"{len(all_of_them) - len(few)} more options: --help-all" in brief.out


def test_a_shell_completes_commands_and_their_options():
    """As bash asks; only the command that is meant is imported."""

    def completed(words: str) -> list[str]:
        environment = os.environ | {
            "_RENDEZVIEW_COMPLETE": "complete_bash",
            "_TYPER_COMPLETE_ARGS": words,
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split()) - 1),
        }
        program = "import sys; sys.argv = ['rendezview']; from rendezview.cli.main import main; "
        return python("-c", program + "main()", env=environment).stdout.split()

    assert completed("rendezview tr") == ["train", "track"]
    assert completed("rendezview track --al") == ["--alarm-attitude-deg", "--alarm-position-m"]


def test_the_version_is_told(run):
    assert run("--version").out == "rendezview 0.3.0\n"


@pytest.mark.parametrize(
    "arguments",
    [[], ["nosuch"], ["--bogus"], *([c, "--bogus"] for c in COMMANDS), ["train"], ["track", "m"],
     ["simulate", "x", "-o", "y", "--trajectory", "zigzag"],
     ["train", "x", "-o", "y", "--order", "a"],
     ["simulate", "client", "-o", "y", "--trajectory", "vbar", "--sun-phase", "270"],
     ["simulate", "client", "-o", "y", "--trajectory", "vbar", "--frames", "0"],
     ["simulate", "client", "-o", "y", "--trajectory", "vbar", "--seed", "-1"],
     ["demo", "--frames", "0"]],
    ids=" ".join,
)  # fmt: skip
def test_wrong_usage_exits_with_2(run, arguments: list[str]):
    ran = run(*arguments)
    assert ran.code == 2
    assert "Usage: " in ran.err
    assert "Traceback" not in ran.err
