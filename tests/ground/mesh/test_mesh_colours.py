"""Colours of mesh files: materials, textures, vertex and face colours."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.ground.mesh.mesh_samples import box, checker, export, note_with, three_mf, write
from tests.processes import python

from rendezview_ground.mesh.colours import GREY, linear_from_srgb
from rendezview_ground.mesh.mesh import load_mesh

# --- colours --------------------------------------------------------------------------


def test_srgb_is_made_linear_by_the_standard_curve() -> None:
    # IEC 61966-2-1: 0.5 -> 0.2140, the linear toe is 1/12.92
    np.testing.assert_allclose(
        linear_from_srgb([0.0, 0.04, 0.5, 1.0]), [0, 0.04 / 12.92, 0.21404, 1], atol=1e-5
    )


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_faces_are_grey_where_the_file_gives_no_colour(tmp_path: Path, suffix: str) -> None:
    mesh = load_mesh(export(tmp_path, suffix, trimesh.Trimesh(box().vertices, box().faces)))
    np.testing.assert_allclose(mesh.face_rgb, GREY)
    note_with(mesh, "No usable colours")


def test_ply_face_colours_become_linear(tmp_path: Path) -> None:
    made = box()
    made.visual.face_colors = [[255, 128, 0, 255]] * 6 + [[0, 0, 64, 255]] * 6
    mesh = load_mesh(export(tmp_path, "ply", made))
    np.testing.assert_allclose(mesh.face_rgb[0], linear_from_srgb([1, 128 / 255, 0]), atol=1e-6)
    np.testing.assert_allclose(mesh.face_rgb[11], linear_from_srgb([0, 0, 64 / 255]), atol=1e-6)


def test_ply_vertex_colours_are_averaged_after_linearising(tmp_path: Path) -> None:
    made = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    made.visual.vertex_colors = [[255, 0, 0, 255], [128, 0, 0, 255], [0, 0, 0, 255]]
    mesh = load_mesh(export(tmp_path, "ply", made))
    mean = linear_from_srgb([1.0, 128 / 255, 0.0]).mean()
    np.testing.assert_allclose(mesh.face_rgb, [[mean, 0, 0]], atol=1e-6)


@pytest.mark.parametrize(("suffix", "linear"), [("glb", True), ("dae", False)])
def test_a_base_colour_of_a_glb_is_linear_already_and_a_diffuse_of_a_dae_is_srgb(
    tmp_path: Path, suffix: str, linear: bool
) -> None:
    made, rgb = box(), [0.2, 0.4, 0.8]
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[*rgb, 1.0])
    made.visual = trimesh.visual.TextureVisuals(material=material)
    mesh = load_mesh(export(tmp_path, suffix, made))
    expected = rgb if linear else linear_from_srgb(rgb)
    np.testing.assert_allclose(mesh.face_rgb, np.tile(expected, (12, 1)), atol=1e-6)


def test_3mf_colours_of_object_triangle_and_colour_group(tmp_path: Path) -> None:
    mesh = load_mesh(three_mf(tmp_path / "t.3mf", "meter", 1.0))
    orange = linear_from_srgb([1, 128 / 255, 0])
    np.testing.assert_allclose(mesh.face_rgb, [orange, [0] * 3, [0, 0, 1], [GREY] * 3], atol=1e-6)


def stl_with_words(path: Path, words: list[int], header: bytes = b"") -> Path:
    content = bytearray(trimesh.exchange.stl.export_stl(box()))
    content[: len(header)] = header
    for k, word in enumerate(words):
        content[84 + 50 * k + 48 : 84 + 50 * k + 50] = word.to_bytes(2, "little")
    return write(path, bytes(content))


def test_viscam_stl_words_are_blue_low_and_flagged(tmp_path: Path) -> None:
    mesh = load_mesh(stl_with_words(tmp_path / "a.stl", [0x8000 | 31, 0x8000 | 31 << 10, 31]))
    expected = [[0, 0, 1], [1, 0, 0], [GREY] * 3]
    np.testing.assert_allclose(mesh.face_rgb[:3], expected, atol=1e-6)
    note_with(mesh, "2 faces with an STL colour")


def test_magics_stl_words_are_red_low_and_unflagged(tmp_path: Path) -> None:
    path = stl_with_words(tmp_path / "a.stl", [31, 0x8000], b"COLOR=\x00\xff\x00\xff")
    np.testing.assert_allclose(load_mesh(path).face_rgb[:2], [[1, 0, 0], [0, 1, 0]], atol=1e-6)


TEXTURED_OBJ = (
    "mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nv 3 0 0\nv 2 1 0\n"
    "vt 0.1 0.1\nvt 0.4 0.1\nvt 0.1 0.4\nvt 0.6 0.1\nvt 0.9 0.1\nvt 0.6 0.4\n"
    "usemtl skin\nf 1/1 2/2 3/3\nf 4/4 5/5 6/6\n"
)


def test_obj_texture_gives_the_colour_of_each_face(tmp_path: Path) -> None:
    checker(tmp_path / "skin.png")
    write(tmp_path / "t.mtl", "newmtl skin\nKd 1 1 1\nmap_Kd -s 1 1 1 C:\\old\\skin.png\n")
    mesh = load_mesh(write(tmp_path / "t.obj", TEXTURED_OBJ))
    np.testing.assert_allclose(mesh.face_rgb, [[1, 0, 0], [0, 0, 1]], atol=1e-6)


def textured_glb(folder: Path) -> Path:
    image = checker(folder / "skin.png")
    made = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3, 0, 0], [2, 1, 0]],
        [[0, 1, 2], [3, 4, 5]],
        process=False,
    )
    uv = [[0.1, 0.1], [0.4, 0.1], [0.1, 0.4], [0.6, 0.1], [0.9, 0.1], [0.6, 0.4]]
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=image, baseColorFactor=[1.0, 1.0, 1.0, 1.0]
    )
    made.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return export(folder, "glb", made)


def test_glb_texture_gives_the_colour_of_each_face(tmp_path: Path) -> None:
    mesh = load_mesh(textured_glb(tmp_path))
    np.testing.assert_allclose(mesh.face_rgb, [[1, 0, 0], [0, 0, 1]], atol=1e-6)


def test_missing_texture_of_an_obj_is_noted(tmp_path: Path) -> None:
    write(tmp_path / "t.mtl", "newmtl skin\nKd 1 1 1\nmap_Kd gone.png\n")
    mesh = load_mesh(write(tmp_path / "t.obj", TEXTURED_OBJ))
    note_with(mesh, "Texture gone.png not found")
    np.testing.assert_allclose(mesh.face_rgb, GREY)


def test_damaged_texture_of_an_obj_is_noted(tmp_path: Path) -> None:
    write(tmp_path / "gone.png", b"not a picture")
    write(tmp_path / "t.mtl", "newmtl skin\nmap_Kd gone.png\nKd 0.5 0.5 0.5\n")
    mesh = load_mesh(write(tmp_path / "t.obj", TEXTURED_OBJ))
    note_with(mesh, "Texture gone.png not readable")
    np.testing.assert_allclose(mesh.face_rgb, linear_from_srgb([[0.5] * 3] * 2), atol=1e-6)


def test_missing_texture_of_a_gltf_is_noted(tmp_path: Path) -> None:
    made = export(tmp_path, "gltf", box())
    tree = json.loads(made.read_text())
    tree["images"] = [{"uri": "gone.png"}]
    tree["textures"] = [{"source": 0}]
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    mesh = load_mesh(write(made, json.dumps(tree)))
    note_with(mesh, "Textures not found or not readable")
    np.testing.assert_allclose(mesh.face_rgb, GREY)


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_textured_mesh_loads_with_a_note_without_pillow(tmp_path: Path, suffix: str) -> None:
    path = textured_glb(tmp_path)
    if suffix == "obj":
        write(tmp_path / "t.mtl", "newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n")
        path = write(tmp_path / "t.obj", TEXTURED_OBJ)
    program = (
        "import sys\n"
        "class Blocker:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'PIL':\n"
        "            raise ImportError('blocked: ' + name)\n"
        "sys.meta_path.insert(0, Blocker())\n"
        "from pathlib import Path\n"
        "from rendezview_ground.mesh.mesh import load_mesh\n"
        "mesh = load_mesh(Path(sys.argv[1]))\n"
        "print(len(mesh.faces), float(mesh.face_rgb.min()), *mesh.notes, sep='\\n')\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = python("-W", "error", "-c", program, path, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0] == "2"
    assert float(lines[1]) == pytest.approx(GREY)
    assert sum("install Pillow" in line for line in lines) == 1
