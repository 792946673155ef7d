"""Commands of the pages, as they stand there and in their order, with small models, few frames."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import trimesh

from rendezview import Recognizer, Tracker, ViewModel, load_camera
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import save_camera
from rendezview.io.sequences import open_sequence
from rendezview.sensors.beacons.rig_files import save_rig
from rendezview_ground.simulate.led_laboratory import Laboratory

ROOT = Path(__file__).resolve().parents[2]
SHORT = {
    "train": "--order 0 --views 60 --held-out 0 --resolution 128 --shells 1,2 --jobs 1",
    "simulate": "--frames 6 --jobs 1",
    "assess": "--frames 4 --jobs 1",
}
# Pages, the files that their reader has, and how a command begins that is run elsewhere: it wants a
# device, a server, a long flight or another recording.
PAGES = [
    ("README.md", "mysat.stl camera.yaml", "track mysat.rvm 0"),
    ("docs/tutorial.md", "mysat.glb camera.json", ""),
    ("docs/own_target.md", "mysat.stl camera.yaml images", "calibrate shape"),
    ("docs/evaluation.md", "SCENE mysat.rvm poses.csv ours.csv theirs.csv", "assess"),
    ("docs/integrity.md", "hubble.rvm approach", ""),
    ("docs/flight-code.md", "hubble.rvm", ""),
    ("docs/simulation.md", "", ""),
    ("docs/refinement.md", "hubble.rvm SCENE", "train"),
    ("docs/reflectors-options.md", "", "calibrate|reflectors (client|.*--calibration)"),
    ("docs/ring.md", "frames camera.yaml", "ring approach"),
    ("docs/stereo-laboratory.md", "rig.json", "calibrate|stereo .* readings.jsonl"),
    ("docs/webcam.md", "", "calibrate camera|reflectors"),
]  # fmt: skip


@pytest.fixture
def have(mesh_path, bumpy_mesh, scene, refining_model, laboratory: Laboratory, run):
    """Makes a file that a reader of the pages has."""

    def make(name: str) -> None:
        if name in ("approach", "SCENE"):
            Path(name).symlink_to(scene)
        elif name in ("images", "frames"):
            Path(name).symlink_to(scene / "gray")
        elif name.endswith(".rvm"):
            refining_model.save(name)
        elif name.endswith((".stl", ".glb")):
            size = 1000.0 if name.endswith(".stl") else 1.0
            trimesh.Trimesh(size * bumpy_mesh.vertices_m, bumpy_mesh.faces).export(name)
        elif name.startswith("camera"):
            save_camera(Camera(640, 480, 640.0, 640.0, 319.5, 239.5), name)
        elif name.endswith(".csv"):
            assert run("track", "mysat.rvm", "SCENE", "-o", name).code == 0
        else:
            save_rig(laboratory.rig, name)

    return make


@pytest.mark.parametrize(("page", "given", "elsewhere"), PAGES)
def test_the_commands_of_a_page_run(page, given, elsewhere, have, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in given.split():
        have(name)
    text = (ROOT / page).read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = "\n".join(re.findall(r"^```.*?^```$", text, re.DOTALL | re.MULTILINE))
    ran = []
    for line in re.findall(r"^rendezview (.*)$", blocks, re.MULTILINE):
        if elsewhere and re.match(elsewhere, line):
            continue
        words = shlex.split(line, comments=True)
        done = run(*words, *SHORT.get(words[0], "").split())
        assert done.code == 0, (line, done.err)
        ran.append(line)
    assert ran


@pytest.mark.parametrize("page", ["README.md", "docs/recognizer.md", "docs/refinement.md"])
def test_the_python_of_a_page_runs(page, have, scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("mysat.rvm", "hubble.rvm", "camera.yaml"):
        have(name)
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text("utf-8"), re.S | re.M)
    names: dict = {
        "Recognizer": Recognizer,
        "Tracker": Tracker,
        "ViewModel": ViewModel,
        "time_s": 0.0,
    }
    names |= {"model": ViewModel.load("mysat.rvm"), "camera": load_camera("camera.yaml")}
    names["image"] = open_sequence(scene).frames[0].read()
    exec(code, names)
    assert names["observation"].pose is not None
