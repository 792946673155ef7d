"""Nodes of a scene by name, and STEP files."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.ground.mesh.step_file import step_box

from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.target import Target, split_node
from rendezview_ground.mesh.mesh import load_mesh

CASCADIO = importlib.util.find_spec("cascadio") is not None


@pytest.fixture
def scene_path(tmp_path: Path) -> Path:
    """A craft with a panel on its side, and the floor of a laboratory."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1.0, 2.0, 3.0)), "craft", "body")
    beside = trimesh.transformations.translation_matrix((3.0, 0.0, 0.0))
    scene.add_geometry(trimesh.creation.box((4.0, 1.0, 0.1)), "panel", "panel", "craft", beside)
    scene.add_geometry(trimesh.creation.box((50.0, 50.0, 0.1)), "floor", "floor")
    path = tmp_path / "scene.glb"
    scene.export(path)
    return path


def test_a_node_is_read_with_what_hangs_below_it_in_the_scenes_frame(scene_path: Path) -> None:
    assert load_mesh(scene_path).extent_m.max() == pytest.approx(50.0)
    craft = load_mesh(Path(f"{scene_path}#craft"))
    np.testing.assert_allclose(craft.extent_m, [5.5, 2.0, 3.0])
    panel = load_mesh(Path(f"{scene_path}#panel"))
    np.testing.assert_allclose(panel.extent_m, [4.0, 1.0, 0.1])
    assert panel.vertices_m[:, 0].mean() == pytest.approx(3.0)


def test_an_unknown_node_lists_those_that_there_are(scene_path: Path) -> None:
    with pytest.raises(RendezviewError, match=r"no node 'bus'; it has craft, floor, panel"):
        load_mesh(Path(f"{scene_path}#bus"))


def test_targets_name_a_node_too(scene_path: Path) -> None:
    assert find_target(f"{scene_path}#craft").name == "craft"
    folder = scene_path.parent
    (folder / "target.toml").write_text(
        'name = "x"\n[mesh]\npath = "scene.glb#craft"\nunit = "m"\n'
    )
    mesh = load_mesh(Target.load(folder).mesh_path)
    np.testing.assert_allclose(mesh.extent_m, [5.5, 2.0, 3.0])
    assert split_node(scene_path) == (scene_path, None)


def test_a_file_with_a_hash_in_its_name_is_that_file(scene_path: Path) -> None:
    other = scene_path.with_name("scene#2.glb")
    scene_path.rename(other)
    assert split_node(other) == (other, None)
    assert load_mesh(other).extent_m.max() == pytest.approx(50.0)


def test_obj_files_have_no_nodes(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "a.obj")
    with pytest.raises(RendezviewError, match="OBJ files have no nodes"):
        load_mesh(tmp_path / "a.obj#body")


@pytest.mark.skipif(not CASCADIO, reason="the extra `step` is not installed")
@pytest.mark.parametrize("suffix", [".step", ".stp"])
def test_a_step_file_is_read_in_metres(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box{suffix}"
    path.write_text(step_box((2000.0, 1200.0, 800.0)))
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.extent_m, [2.0, 1.2, 0.8], rtol=1e-6)
    assert len(mesh.faces) == 12
    assert any("STEP surfaces as 12 triangles" in note for note in mesh.notes)
    assert not any("Not watertight" in note for note in mesh.notes)


@pytest.mark.skipif(not CASCADIO, reason="the extra `step` is not installed")
def test_what_is_no_step_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.step").write_text("ISO-10303-21;\nnothing\n")
    with pytest.raises(RendezviewError, match=r"a\.step cannot be read as STEP"):
        load_mesh(tmp_path / "a.step")


def test_without_the_extra_a_step_file_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cascadio", None)
    (tmp_path / "a.step").write_text("ISO-10303-21;\n")
    with pytest.raises(RendezviewError, match=r"pip install 'rendezview\[step\]', or export"):
        load_mesh(tmp_path / "a.step")
