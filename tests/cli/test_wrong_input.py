"""Every kind of wrong file: exit 1, one line that says what to do, nothing left behind."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

TINY = ["--order", "1", "--views", "300", "--held-out", "50", "--resolution", "96", "--jobs", "1"]
TETRAHEDRON = "v {0} 0 0\nv 0 {1} 0\nv 0 0 {2}\nv 0 0 0\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"


@pytest.mark.requirement("RV-CMD-1")
@pytest.mark.parametrize(
    "arguments",
    ["track NO SCENE -o OUT", "track MODEL NO -o OUT", "track MODEL SCENE -o NO/x.csv",
     "track MODEL SCENE -o SCENE", "track MODEL SCENE -o OUT --log NO/x.jsonl",
     "track MODEL SCENE -o OUT --camera NO", "track MODEL SCENE -o OUT --prior NO",
     "track MODEL SCENE -o OUT --prior 0,0,0,0", "track MODEL SCENE -o OUT --prior nan,0,0,1",
     "track MODEL SCENE -o OUT --prior 1,2", "track MODEL SCENE -o OUT --prior MODEL",
     "track MODEL SCENE -o OUT --threshold 300", "track MODEL SCENE -o OUT --threshold nan",
     "track MODEL SCENE -o OUT --obj-id 7 --prior scene", "track MODEL SCENE/gray -o OUT",
     "track MODEL SCENE -o OUT --log OUT", "track MODEL SCENE -o MODEL", "track SCENE SCENE -o OUT",
     "train NO -o OUT", "train MESH -o NO/x.rvm", "train MESH -o OUT --camera NO",
     "train MESH -o OUT --unit furlong", "train MESH -o OUT --jobs 0",
     "train MESH -o OUT --order -1", "train MESH -o OUT --bins 100000", "train SCENE -o OUT",
     "train MODEL -o OUT", "train MESH -o OUT --views -5", "train MESH -o OUT --sphere-radius nan",
     "simulate NO -o OUT --trajectory vbar", "simulate MESH -o SCENE --trajectory vbar",
     "simulate MESH -o MODEL --trajectory vbar", "simulate MESH -o OUT --trajectory vbar --dt 0",
     "simulate MESH -o OUT --trajectory vbar --camera NO",
     "simulate MESH -o OUT --trajectory vbar --sun-direction 0,0,0",
     "simulate MESH -o OUT --trajectory vbar --noise nan",
     "simulate MESH -o OUT --trajectory vbar --overexposure 0",
     "simulate MESH -o OUT --trajectory vbar --bloom 1",
     "simulate MESH -o OUT --trajectory vbar --black-level 300",
     "simulate MESH -o OUT --trajectory vbar --sky-level -1",
     "simulate MESH -o OUT --trajectory vbar --dust -1",
     "simulate MESH -o OUT --trajectory vbar --mesh-error 0.9",
     "evaluate NO POSES", "evaluate SCENE NO", "evaluate SCENE MODEL", "evaluate SCENE/gray POSES",
     "evaluate SCENE POSES --target NO", "evaluate SCENE POSES --camera NO",
     "evaluate SCENE POSES --obj-id 4", "evaluate SCENE POSES --wrong nan",
     "evaluate SCENE POSES --wrong -1",
     "show NO", "show POSES -o OUT", "show MODEL -o MODEL", "show SCENE/gray -o OUT",
     "export NO --listing", "export MODEL", "export MODEL --listing --rules",
     "export MODEL --listing --node 999", "export MODEL --listing --node -1",
     "export MODEL --listing -o NO/x", "export POSES --listing"],
)  # fmt: skip
def test_a_fault_is_one_line_and_leaves_nothing(
    files_below,
    run,
    tiny_model_path: Path,
    scene: Path,
    mesh_path: Path,
    tmp_path: Path,
    arguments: str,
):
    places = {
        "MODEL": tmp_path / "model.rvm",
        "SCENE": scene,
        "MESH": mesh_path,
        "NO": tmp_path / "no-such-thing",
        "OUT": tmp_path / "out",
        "POSES": tmp_path / "poses.csv",
    }
    shutil.copy(tiny_model_path, places["MODEL"])
    places["POSES"].write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    before = places["MODEL"].read_bytes()
    for name, path in places.items():
        arguments = arguments.replace(name, str(path))
    run(*arguments.split()).says()
    assert files_below(tmp_path) == {"model.rvm", "poses.csv"}
    assert places["MODEL"].read_bytes() == before


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("zero.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("zero.stl", "solid a\nendsolid a\n", "zero.stl"),
        ("empty.stl", "", "empty"),
        ("nan.obj", TETRAHEDRON.format("nan", "nan", "nan"), "not a usable number"),
        ("mm.obj", TETRAHEDRON.format(4000, 3000, 1000), "--unit"),
        ("bad.toml", 'mesh = "x.stl"\nfoo = 1\n', "foo"),
    ],
)
def test_a_wrong_mesh_is_told(files_below, run, tmp_path: Path, name: str, content: str, word: str):
    (tmp_path / name).write_text(content)
    run("train", tmp_path / name, "-o", tmp_path / "out.rvm", *TINY).says(name, word)
    assert files_below(tmp_path) == {name}


def test_a_flat_target_is_told_in_one_line(run, tmp_path: Path):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    run("train", tmp_path / "flat.obj", "-o", tmp_path / "out.rvm", *TINY).says("flat")
    assert not (tmp_path / "out.rvm").exists()


def test_a_small_sphere_is_told_with_the_least_that_works(run, mesh_path: Path, tmp_path: Path):
    ran = run("train", mesh_path, "-o", tmp_path / "x.rvm", "--sphere-radius", 0.5)
    ran.says("does not enclose", "give at least")


def _flip(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


@pytest.mark.requirement("RV-MODEL-1")
@pytest.mark.parametrize(
    ("damage", "word"),
    [
        (lambda data: data[: len(data) // 2], "cut off"),
        (lambda data: data[:10], "cut off"),
        (lambda data: _flip(data, len(data) // 2), "damaged"),
        (lambda data: _flip(data, len(data) - 3), "damaged"),
        (lambda data: data[:4] + b"\x09" + data[5:], "format 9"),
        (lambda data: b"PNG" + data, "not a rendezview model"),
        (lambda data: b"", "not a rendezview model"),
    ],
    ids=["half", "ten bytes", "bit", "bit of checksum", "newer", "another kind", "empty"],
)
@pytest.mark.parametrize("command", ["track", "export", "show"])
def test_a_damaged_model_is_told(
    files_below,
    run,
    tiny_model_path: Path,
    scene: Path,
    tmp_path: Path,
    command: str,
    damage,
    word: str,
):
    model = tmp_path / "bad.rvm"
    model.write_bytes(damage(tiny_model_path.read_bytes()))
    more = {
        "track": [scene, "-o", tmp_path / "out.csv"],
        "export": ["--listing"],
        "show": ["-o", tmp_path / "pictures"],
    }[command]
    run(command, model, *more).says("bad.rvm", word)
    assert files_below(tmp_path) == {"bad.rvm"}


@pytest.mark.parametrize(("key", "value"), [("fx", float("nan")), ("fx", -3.0), ("width", "wide")])
def test_a_wrong_camera_file_is_told(
    files_below,
    run,
    tiny_model_path: Path,
    scene: Path,
    mesh_path: Path,
    tmp_path: Path,
    key: str,
    value,
):
    camera = tmp_path / "camera.json"
    content = json.loads((scene / "camera.json").read_text()) | {key: value}
    camera.write_text(json.dumps(content))
    for arguments in (
        ("track", tiny_model_path, scene, "-o", tmp_path / "x"),
        ("train", mesh_path, "-o", tmp_path / "x"),
        ("simulate", mesh_path, "-o", tmp_path / "x", "--trajectory", "vbar"),
    ):
        run(*arguments, "--camera", camera).says("camera.json")
    assert files_below(tmp_path) == {"camera.json"}


@pytest.mark.parametrize("content", ["", "[1]\n", '{"pose": 3}\n', "x\n", '{"im_id": 0}\n'])
def test_a_wrong_log_is_told(files_below, run, tmp_path: Path, content: str):
    (tmp_path / "log.jsonl").write_text(content)
    run("show", tmp_path / "log.jsonl", "-o", tmp_path / "out").says("log.jsonl")
    assert files_below(tmp_path) == {"log.jsonl"}


BAD = {
    1: "unreadable",  # no image
    2: "unreadable",  # of another size
    3: "empty",  # black
    4: "full",  # white
    5: "rivals",
    6: "border",
    7: "empty",  # the target is out of the frame
}


@pytest.fixture
def bad_scene(scene: Path, tmp_path: Path) -> Path:
    """The first and the last frame are good, those of BAD are not."""
    folder = tmp_path / "bad"
    shutil.copytree(scene, folder)

    def path(k: int) -> Path:
        return folder / "gray" / f"{k:06d}.png"

    frames = [cv2.imread(str(path(k)), cv2.IMREAD_GRAYSCALE) for k in range(9)]
    noise = np.random.default_rng(1).normal(8.0, 3.0, frames[0].shape)
    background = np.clip(noise, 0, 255).astype(np.uint8)
    path(1).write_bytes(b"this is no picture")
    cv2.imwrite(str(path(2)), frames[2][:, :600])
    cv2.imwrite(str(path(3)), np.zeros_like(frames[3]))
    cv2.imwrite(str(path(4)), np.full_like(frames[4], 255))
    cv2.imwrite(str(path(5)), np.maximum(frames[5], np.roll(frames[5], 200, axis=1)))
    cv2.imwrite(str(path(7)), background)
    moved = background.copy()
    moved[:, 300:] = frames[6][:, :340]
    cv2.imwrite(str(path(6)), moved)
    return folder


def _tracked(run, model: Path, scene: Path, *options: object) -> list[dict]:
    log = scene.parent / "log.jsonl"
    ran = run("track", model, scene, "-o", scene.parent / "p.csv", "--log", log, *options)
    assert ran.code == 0, ran
    assert ran.err.count("\n") == 1
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [r["im_id"] for r in records] == list(range(9))  # every frame is counted
    return records


@pytest.mark.requirement("RV-TRACK-2")
def test_bad_frames_say_why_and_the_rest_goes_on(run, tiny_model_path: Path, bad_scene: Path):
    records = _tracked(run, tiny_model_path, bad_scene, "--independent")
    assert {k: records[k]["status"] for k in BAD} == BAD
    for k in BAD:
        assert records[k]["reason"]
        assert records[k]["pose"] is None
    assert "600 × 480" in records[2]["reason"]
    assert "000001.png" in records[1]["reason"]


def test_a_prior_chooses_between_two_targets_and_bridges_bad_frames(
    run, tiny_model_path: Path, bad_scene: Path
):
    records = _tracked(run, tiny_model_path, bad_scene, "--prior", "scene")
    assert {k: records[k]["status"] for k in BAD} == BAD | {5: "ok"}
    assert [records[0]["status"], records[8]["status"]] == ["ok", "ok"]
    x_m, _, z_m = records[5]["pose"]["translation_m"]
    assert abs(x_m / z_m) < 0.1  # the one in the middle, not its copy 200 px to the right


def test_a_sheet_of_frames_shows_those_that_cannot_be_read(run, bad_scene: Path):
    ran = run("show", bad_scene, "-o", bad_scene.parent / "sheet")
    assert ran.code == 0, ran
    assert (bad_scene.parent / "sheet" / "frames.png").is_file()


def test_show_makes_no_folder_with_the_name_of_a_picture(run, bad_scene: Path, tmp_path: Path):
    run("show", bad_scene, "-o", tmp_path / "a.PNG").says("a.PNG", "into a folder")
    assert not (tmp_path / "a.PNG").exists()


def test_show_draws_a_camera_of_colmap(run, tmp_path: Path):
    (tmp_path / "cameras.txt").write_text("1 OPENCV 640 480 641 641 319 239 -0.1 0 0 0\n")
    assert run("show", tmp_path / "cameras.txt", "-o", tmp_path / "out").code == 0
    assert (tmp_path / "out" / "camera.png").is_file()
    run("show", tmp_path, "-o", tmp_path / "x").says("no images in it")


def test_a_camera_that_fits_no_frame_is_refused_before_the_run(
    run, tiny_model_path: Path, scene: Path, tmp_path: Path
):
    camera = tmp_path / "camera.json"
    content = json.loads((scene / "camera.json").read_text()) | {"width": 1024}
    camera.write_text(json.dumps(content))
    out = tmp_path / "p.csv"
    ran = run("track", tiny_model_path, scene, "-o", out, "--camera", camera)
    ran.says("the image is 640 × 480", "but its camera 1024 × 480", "camera.json would fit")
    assert not out.exists()
