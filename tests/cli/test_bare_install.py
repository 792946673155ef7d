"""What flies needs nothing of the ground side: a process without it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from tests.processes import python

GROUND = ("trimesh", "sklearn", "joblib", "matplotlib", "networkx", "lxml", "PIL", "pyrender",
          "OpenGL", "rendezview_ground")  # fmt: skip
BLOCKER = f"""
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        for refused in {GROUND!r}:
            if name == refused or name.startswith(refused + "."):
                raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Blocker())
import rendezview.sensors.appearance
from rendezview.cli.main import main
main()
"""


def _bare(*arguments: object) -> subprocess.CompletedProcess[str]:
    return python("-c", BLOCKER, *arguments)


@pytest.mark.requirement("RV-CMD-3")
def test_tracking_and_export_run_without_the_ground_side(
    tiny_model_path: Path, scene: Path, tmp_path: Path
):
    out = tmp_path / "poses.csv"
    done = _bare("track", tiny_model_path, scene, "-o", out, "--prior", "scene")
    assert done.returncode == 0, done.stderr
    assert " in 9 frames" in done.stderr
    assert len(out.read_text().splitlines()) > 1
    assert _bare("export", tiny_model_path, "--rules", "--node", 0).stdout.startswith("Node 0")


def test_ground_commands_say_what_to_install():
    # Here the packages stand in for the whole ground side, whose code every wheel holds.
    program = BLOCKER.replace(repr(GROUND), repr(GROUND[:9]))
    done = python("-c", program, "train", "--help")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("rendezview: ")
    assert "pip install 'rendezview[training]'" in done.stderr


def test_recordings_say_which_package_they_need(tiny_model_path: Path, tmp_path: Path):
    each = """
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["rendezview", *arguments]
    try:
        main()
    except SystemExit as end:
        assert end.code == 1, end.code
"""
    program = "import json\n" + BLOCKER.replace(repr(GROUND), repr(("rosbags", "mcap", "rerun")))
    program = program.replace("\nmain()\n", each)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "a.jsonl").write_text('{"status": "ok", "time_s": 0.0, "pose": null}\n')
    track = ("track", tiny_model_path)
    commands = (
        (*track, tmp_path / "a.bag", "-o", tmp_path / "a.csv"),
        (*track, tmp_path / "a.mcap", "-o", tmp_path / "a.csv"),
        ("rrd", tmp_path / "a.jsonl", "-o", tmp_path / "a.rrd"),
    )
    done = python("-c", program, json.dumps([[*map(str, words)] for words in commands]))
    lines = done.stderr.splitlines()
    assert (done.returncode, len(lines)) == (0, 3), done.stderr
    for line, wanted in zip(lines, ("ros", "service", "rerun"), strict=True):
        assert f"pip install 'rendezview[{wanted}]'" in line


NO_CACHE = """
import sys
from numba.core import caching
caching.CacheImpl._locator_classes = []  # as where nothing can be written
"""


@pytest.mark.parametrize("command", ["track", "train"])  # of what flies, of the ground side
def test_without_a_place_for_compiled_loops_the_variable_is_named(tmp_path: Path, command: str):
    program = NO_CACHE + "from rendezview.cli.main import main\nmain()"
    done = python("-c", program, command, "--help")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert "set NUMBA_CACHE_DIR to a folder that can" in done.stderr


def test_without_a_place_for_compiled_loops_the_library_names_the_variable():
    program = NO_CACHE + (
        "import rendezview\n"
        "try:\n    rendezview.Camera\n"
        "except rendezview.RendezviewError as error:\n    print(error)"
    )
    done = python("-c", program)
    assert "NUMBA_CACHE_DIR" in done.stdout, done.stderr


@pytest.mark.parametrize("name", ["opencv-python", "opencv-contrib-python"])
def test_another_opencv_is_told_in_a_line(tmp_path: Path, name: str):
    folder = tmp_path / f"{name.replace('-', '_')}-4.12.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 4.12.0\n")
    program = (
        f"import sys\nsys.path.append({str(tmp_path)!r})\n"
        "from rendezview.cli.main import main\nmain()"
    )
    for path, lines in ((program, 1), (program.replace(str(tmp_path), "/none"), 0)):
        done = python("-c", path, "--help")
        assert (done.returncode, done.stderr.count("\n")) == (0, lines)
        assert (f"pip uninstall {name}, then" in done.stderr) == bool(lines)


def test_an_opencv_that_lost_its_files_is_one_line(tmp_path: Path):
    (tmp_path / "cv2").mkdir()  # what `pip uninstall opencv-python` leaves of its neighbour
    (tmp_path / "cv2" / "__init__.py").touch()
    program = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    done = python("-c", program + "from rendezview.cli.main import main; main()", "track", "--help")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "--force-reinstall opencv-python-headless" in done.stderr
