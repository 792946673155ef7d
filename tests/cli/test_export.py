"""`rendezview export` writes flight code, or says in one line why not."""

from __future__ import annotations

from pathlib import Path

import pytest


def test_flight_code_goes_into_a_folder(run, files_below, tiny_model_path: Path, tmp_path: Path):
    folder = tmp_path / "new" / "flight"
    ran = run("export", tiny_model_path, "--c", folder)
    assert (ran.code, ran.out) == (0, "")
    assert ran.err == f"{folder}: 12 files, start with README.md\n"
    assert files_below(folder) == {
        "README.md",
        "rendezview_flight.h",
        "rendezview_frame.h",
        "rendezview_model.h",
        "rendezview_model.c",
        "rendezview_forest.c",
        "sky.c",
        "borders.c",
        "silhouette.c",
        "signature.c",
        "trees.c",
        "forest.c",
    }
    assert "rdv_search" in (folder / "README.md").read_text()


def test_the_graph_goes_into_a_file(run, tiny_model_path: Path, tmp_path: Path):
    pytest.importorskip("onnx", reason="onnx is not installed")
    ran = run("export", tiny_model_path, "--onnx", tmp_path / "trees.onnx")
    assert (ran.code, ran.err) == (0, f"{tmp_path / 'trees.onnx'}: 162 trees\n")
    assert list(tmp_path.iterdir()) == [tmp_path / "trees.onnx"]


def test_one_thing_is_exported_at_a_time(run, files_below, tiny_model_path: Path, tmp_path: Path):
    c, onnx = tmp_path / "c", tmp_path / "trees.onnx"
    run("export", tiny_model_path).says("--listing", "--c", "--onnx")
    run("export", tiny_model_path, "--c", c, "--onnx", onnx).says("one of")
    run("export", tiny_model_path, "--c", c, "--node", 3).says("--node")
    run("export", tiny_model_path, "--c", c, "-o", onnx).says("--output")
    assert files_below(tmp_path) == set()


def test_a_file_in_the_way_is_told(run, tiny_model_path: Path, tmp_path: Path):
    (tmp_path / "file").write_text("")
    run("export", tiny_model_path, "--c", tmp_path / "file").says("cannot be created")
    run("export", tiny_model_path, "--onnx", tmp_path).says("is a folder")
    run("export", tmp_path / "no.rvm", "--c", tmp_path / "c").says("no.rvm")
    assert {p.name for p in tmp_path.iterdir()} == {"file"}
