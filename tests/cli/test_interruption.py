"""Ctrl-C, a kill, a full disk: no half-written file, and what was computed is kept."""

from __future__ import annotations

import csv
import json
import os
import resource
import shutil
import signal
from pathlib import Path

import pytest

LONG = ["--order", "1", "--views", "40000", "--held-out", "0", "--resolution", "96", "--jobs", "1"]


def _interrupted(ran) -> None:
    assert (ran.code, ran.err) == (130, "rendezview: interrupted\n")


def _no_temporary_files(folder: Path) -> None:
    assert not list(folder.rglob("*.tmp"))


def test_interrupted_training_leaves_no_model_and_keeps_its_shards(
    spawn, mesh_path: Path, tmp_path: Path
):
    partial = tmp_path / "m.rvm.partial"
    spawned = spawn("train", mesh_path, "-o", tmp_path / "m.rvm", *LONG)
    spawned.wait_for(lambda: any(partial.glob("*/*.npz")))
    _interrupted(spawned.signal(signal.SIGINT))
    assert [path.name for path in tmp_path.iterdir()] == ["m.rvm.partial"]
    _no_temporary_files(tmp_path)


def test_an_interrupted_simulation_leaves_nothing(
    spawn, files_below, mesh_path: Path, tmp_path: Path
):
    spawned = spawn("simulate", mesh_path, "-o", tmp_path / "scene", "--trajectory", "vbar",
                      "--frames", 2000, "--jobs", 1)  # fmt: skip
    spawned.wait_for((tmp_path / "scene" / "gray" / "000001.png").is_file)
    _interrupted(spawned.signal(signal.SIGINT))
    assert files_below(tmp_path) == set()


@pytest.mark.requirement("RV-TRACK-3")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_track_keeps_what_was_computed(
    spawn, files_below, tiny_model_path: Path, scene: Path, prior_path: Path, tmp_path: Path, sent
):
    """By Ctrl-C, or as `timeout`, containers and batch systems end a program."""
    frames = tmp_path / "frames"
    frames.mkdir()
    shutil.copy(scene / "camera.json", frames)
    for k in range(4000):
        os.link(scene / "gray" / "000000.png", frames / f"{k}.png")
    log, poses = tmp_path / "log.jsonl", tmp_path / "poses.csv"
    partial = tmp_path / "log.jsonl.partial"
    spawned = spawn("track", tiny_model_path, frames, "-o", poses, "--log", log,
                      "--prior", prior_path)  # fmt: skip
    spawned.wait_for(lambda: partial.is_file() and partial.stat().st_size > 0)
    _interrupted(spawned.signal(sent))
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert 0 < len(records) < 4000
    rows = list(csv.DictReader(poses.read_text().splitlines()))
    found = [r["im_id"] for r in records if r["pose"] is not None]
    # The signal may come between a row and its line in the log.
    assert [int(row["im_id"]) for row in rows][: len(found)] == found
    assert len(rows) - len(found) in (0, 1)
    assert files_below(tmp_path) >= {"log.jsonl", "poses.csv"}
    assert not partial.exists()


def _small_disk(limit_bytes: int):
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))


def test_training_on_a_full_disk_says_so(spawn, mesh_path: Path, tmp_path: Path):
    spawned = spawn("train", mesh_path, "-o", tmp_path / "m.rvm", *LONG,
                      preexec_fn=_small_disk(20_000))  # fmt: skip
    spawned.end().says("cannot be written")
    assert not (tmp_path / "m.rvm").exists()
    _no_temporary_files(tmp_path)


def test_a_log_on_a_full_disk_does_not_take_the_poses_with_it(
    spawn, run, tiny_model_path: Path, scene: Path, tmp_path: Path
):
    log, poses = tmp_path / "log.jsonl", tmp_path / "poses.csv"
    arguments = ("track", tiny_model_path, scene, "-o", poses, "--log", log, "--prior", "scene")
    assert run(*arguments).code == 0
    whole = log.stat().st_size
    log.unlink()
    poses.unlink()
    spawned = spawn(*arguments, preexec_fn=_small_disk(whole * 2 // 3))
    spawned.end().says("log.jsonl", "cannot be written")
    assert not log.exists()
    assert not poses.exists()  # only what is complete has its name
    rows = list(csv.DictReader((tmp_path / "poses.csv.partial").read_text().splitlines()))
    assert [int(row["im_id"]) for row in rows][:3] == [0, 1, 2]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_output_is_one_line(tiny_model_path: Path, scene: Path, run):
    run("track", tiny_model_path, scene, "-o", "/dev/full").says("/dev/full", "No space left")
    run("export", tiny_model_path, "--listing", "-o", "/dev/full").says("No space left")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_standard_output_is_one_line(spawn, tiny_model_path: Path):
    with open("/dev/full", "w") as full:
        spawned = spawn("export", tiny_model_path, "--listing")
        spawned.end()
        spawned = spawn("export", tiny_model_path, "--listing", stdout=full)
        spawned.end().says("No space left")
