"""Check that a plain install tracks: no extras, only what pip install rendezview brings."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

from experiments.frame import ROOT

GROUND = ("trimesh", "sklearn", "joblib", "matplotlib", "networkx", "lxml", "PIL", "collada")
TRAIN = "client --order 1 --views 300 --held-out 50 --resolution 96 --jobs 1"
SIMULATE = "client --trajectory circular --frames 5 --jobs 1"


def run(*, keep: Annotated[Path | None, "folder to work in, kept afterwards"] = None) -> int:
    """Check that a plain install tracks: no extras, only what pip install rendezview brings.

    Builds a wheel, installs it into a new virtual environment without extras, tracks a scene with
    a model (both made here), imports the recognition, and checks the messages of the ground side's
    commands. Takes some minutes, most of them for downloads.
    """
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
        return _check(keep.resolve())
    with tempfile.TemporaryDirectory() as folder:
        return _check(Path(folder))


def _check(work: Path) -> int:
    model, scene, poses = work / "client.rvm", work / "scene", work / "poses.csv"
    bare, python = work / "bare", work / "bare" / "bin" / "python"
    command = bare / "bin" / "rendezview"
    here = [sys.executable, "-c", "from rendezview.cli.main import main; main()"]
    _run("train here", [*here, "train", *TRAIN.split(), "-o", str(model)])
    _run("simulate here", [*here, "simulate", *SIMULATE.split(), "-o", str(scene), "--overwrite"])
    _run("build a wheel", [sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", str(work),
                           str(ROOT)])  # fmt: skip
    _run("make an environment", [sys.executable, "-m", "venv", "--clear", str(bare)])
    wheel = max(work.glob("rendezview-*.whl"), key=lambda path: path.stat().st_mtime)
    _run("install without extras", [str(python), "-m", "pip", "install", str(wheel)])
    _run("import", [str(python), "-c", _import_program()])
    tracked = _run(
        "track",
        [str(command), "track", str(model), str(scene), "-o", str(poses), "--prior", "scene"],
    )
    holds = [
        _say(" in 5 frames" in tracked.stderr, "track counts its frames", tracked.stderr),
        _say(len(poses.read_text().splitlines()) > 1, "track found poses", poses.read_text()[:200]),
    ]
    for name in ("demo", "train", "simulate", "evaluate", "show"):
        said = _run(name, [str(command), name, "--help"], expect=1).stderr
        one_line = said.count("\n") == 1 and said.startswith("rendezview: ")
        holds.append(_say(one_line and "rendezview[training]" in said, f"{name} says why", said))
    helped = _run("help", [str(command), "--help"]).stdout
    holds.append(_say("track" in helped, "the list of commands", helped))
    return 0 if all(holds) else 1


def _import_program() -> str:
    return (
        "import importlib.util as u, rendezview.sensors.appearance\n"
        f"there = [n for n in {GROUND!r} if u.find_spec(n)]\n"
        "assert not there, f'this environment is not bare: {there}'\n"
    )


def _run(what: str, command: list[str], expect: int = 0) -> subprocess.CompletedProcess[str]:
    start = time.perf_counter()
    # Away from the checkout and its paths, so that only the installed package is found.
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tempfile.gettempdir(), env=clean, check=False
    )
    print(f"{what}: exit {done.returncode}, {time.perf_counter() - start:.1f} s", flush=True)
    if done.returncode != expect:
        print(done.stdout + done.stderr, file=sys.stderr)
        sys.exit(1)
    return done


def _say(holds: bool, what: str, seen: str) -> bool:
    print(f"{'ok  ' if holds else 'FAIL'}  {what}: {seen.strip().splitlines()[-1:]}")
    return holds
