"""What the tests of the commands share: a mesh file, a scene, and ways to run a command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.made_once import made_once
from tests.waiting import MOST_S, wait_until

from rendezview.cli.main import main
from rendezview.io.sequences import open_sequence
from rendezview_ground.mesh.mesh import Mesh

# What a command says of compiling depends on the cache of the machine: not here.
_COMPILING = ("Compiling ", "Compiled ")
PROGRAM = [sys.executable, "-m", "rendezview"]


@dataclass(frozen=True)
class Ran:
    code: int
    out: str
    err: str

    def says(self, *words: str) -> None:
        """A fault of the user's: exit 1, one line, all of the words, no traceback."""
        lines = self.err.splitlines()
        assert (self.code, len(lines)) == (1, 1), self
        assert lines[0].startswith("rendezview: ")
        assert len(lines[0]) < 500
        for word in words:
            assert word in lines[0]


Run = Callable[..., Ran]


@pytest.fixture(autouse=True)
def quiet_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """See `_COMPILING`."""
    monkeypatch.setattr("rendezview.cli.compiling.say", lambda text: None)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command in this process, as the entry point does."""

    def call(*arguments: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["rendezview", *map(str, arguments)])
        capsys.readouterr()
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code
        assert code is None or isinstance(code, int)
        said = capsys.readouterr()
        return Ran(code or 0, said.out, said.err)

    return call


def _heed_ctrl_c() -> None:
    """A shell's background jobs ignore Ctrl-C, and so would what they start."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Spawned:
    """A command in a process of its own, to be interrupted."""

    def __init__(self, *arguments: object, **options: object) -> None:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(
            [*PROGRAM, *map(str, arguments)],
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            **pipes | {"preexec_fn": _heed_ctrl_c} | options,
        )

    def wait_for(self, happened: Callable[[], bool]) -> Spawned:
        wait_until(lambda: happened() or self.process.poll() is not None)
        assert self.process.poll() is None, self.process.communicate(timeout=MOST_S)
        return self

    def signal(self, number: int) -> Ran:
        self.process.send_signal(number)
        return self.end()

    def end(self) -> Ran:
        try:
            out, err = self.process.communicate(timeout=MOST_S)
        finally:
            self.process.kill()
        told = [line for line in err.splitlines(True) if not line.startswith(_COMPILING)]
        return Ran(self.process.returncode, out, "".join(told))


@pytest.fixture
def spawn() -> Iterator[Callable[..., Spawned]]:
    """Start a command in a process of its own; it does not outlive the test."""
    started = []

    def start(*arguments: object, **options: object) -> Spawned:
        started.append(Spawned(*arguments, **options))
        return started[-1]

    yield start
    for spawned in started:
        spawned.process.kill()
        spawned.process.communicate(timeout=MOST_S)


@pytest.fixture(scope="session")
def mesh_path(tmp_path_factory: pytest.TempPathFactory, bumpy_mesh: Mesh) -> Path:
    path = tmp_path_factory.mktemp("cad") / "bumpy.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in bumpy_mesh.vertices_m]
    lines += [f"f {a} {b} {c}" for a, b, c in bumpy_mesh.faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory, mesh_path: Path) -> Path:
    """Nine frames, 1° apart, the target 160 px wide in the middle of 640 × 480."""

    def simulated(folder: Path) -> None:
        spawned = Spawned(
            *("simulate", mesh_path, "-o", folder, "--trajectory", "circular"),
            *("--frames", 9, "--turn", 8, "--start-range", 14, "--jobs", 1),
        )
        ran = spawned.end()
        assert ran.code == 0, ran

    return made_once(tmp_path_factory, "scene", simulated)


@pytest.fixture(scope="session")
def prior_path(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> Path:
    """The attitude of the scene's first frame as a file."""
    truth = open_sequence(scene).frames[0].camera_from_target
    assert truth is not None
    path = tmp_path_factory.mktemp("prior") / "prior.json"
    path.write_text(json.dumps({"quat_wxyz": list(truth.quat_wxyz)}))
    return path


@pytest.fixture
def files_below() -> Callable[[Path], set[str]]:
    return lambda folder: {str(path.relative_to(folder)) for path in folder.rglob("*")}
