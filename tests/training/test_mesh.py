"""Mesh files of every format become one clean mesh in metres, or a plain error."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from rendezview.errors import RendezviewError
from rendezview.training import mesh as mesh_module
from rendezview.training.bounding_sphere import smallest_enclosing_sphere
from rendezview.training.mesh import Mesh, load_mesh
from rendezview.training.mesh_colours import GREY, linear_from_srgb
from rendezview.training.polygon import triangulate

EXTENT_M = np.array([2.0, 1.0, 0.5])
FORMATS = ["stl", "obj", "ply", "glb", "gltf", "3mf", "dae"]
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def box(scale: float = 1.0) -> trimesh.Trimesh:
    made = trimesh.creation.box(EXTENT_M * scale)
    made.apply_translation(np.array([3.0, -1.0, 0.25]) * scale)
    return made


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def export(folder: Path, suffix: str, scene: object, **options: object) -> Path:
    made = scene.export(file_type=suffix, **options)  # type: ignore[attr-defined]
    if isinstance(made, dict):  # glTF: several files
        for name, content in made.items():
            write(folder / name, content)
        return next(folder.glob("*.gltf"))
    return write(folder / f"mesh.{suffix}", made)


def triangles(mesh: Mesh) -> np.ndarray:
    """Triangles in an order that does not depend on the file's."""
    corner = mesh.vertices_m[mesh.faces].round(6) + 0.0
    rolled = [np.roll(t, -int(np.lexsort(t.T[::-1])[0]), axis=0).ravel() for t in corner]
    return np.array(sorted(map(tuple, rolled)))


def note_with(mesh: Mesh, words: str) -> str:
    found = [note for note in mesh.notes if words in note]
    assert len(found) == 1, mesh.notes
    return found[0]


# --- every format ---------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_each_format_gives_the_same_box_in_metres(tmp_path: Path, suffix: str) -> None:
    if suffix == "3mf":  # its default unit is the millimetre
        mesh = load_mesh(export(tmp_path, suffix, box(1000.0)))
    else:
        mesh = load_mesh(export(tmp_path, suffix, box()))
    reference = box()
    expected = Mesh(reference.vertices, reference.faces.astype(np.int32), np.zeros((12, 3)), ())
    np.testing.assert_allclose(triangles(mesh), triangles(expected), atol=1e-6)
    assert len(mesh.vertices_m) == 8
    assert mesh.faces.dtype == np.int32
    assert mesh.face_rgb.dtype == np.float32
    assert mesh.face_rgb.shape == (12, 3)
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M, atol=1e-6)
    assert "2.00 × 1.00 × 0.50 m" in " ".join(mesh.notes)
    assert not any("watertight" in note or "winding" in note for note in mesh.notes)


@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_text_variants_equal_binary_ones(tmp_path: Path, suffix: str) -> None:
    binary = load_mesh(export(tmp_path, suffix, box()))
    if suffix == "stl":
        text = write(tmp_path / "text.stl", trimesh.exchange.stl.export_stl_ascii(box()))
    else:
        text = write(tmp_path / "text.ply", box().export(file_type="ply", encoding="ascii"))
    np.testing.assert_allclose(triangles(load_mesh(text)), triangles(binary), atol=1e-6)


def test_suffix_in_capitals_is_known(tmp_path: Path) -> None:
    made = export(tmp_path, "stl", box())
    assert len(load_mesh(made.rename(tmp_path / "BOX.STL")).faces) == 12


def test_scene_graph_transforms_are_applied_and_bodies_joined(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1], [0, 0, 0])
    scene.add_geometry(trimesh.creation.box(EXTENT_M), "a", "a", transform=turn)
    move = trimesh.transformations.translation_matrix([10.0, 0, 0])
    scene.add_geometry(trimesh.creation.box([1, 1, 1]), "b", "b", "a", transform=move)
    mesh = load_mesh(export(tmp_path, "glb", scene))
    assert len(mesh.faces) == 24
    # b sits 10 m along a's x, which the turn makes the target's y
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [0.5, 10.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [-0.5, -1.0, -0.5], atol=1e-6)
    note_with(mesh, "2 bodies joined")


# --- units ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)]
)
def test_given_unit_scales_the_mesh(tmp_path: Path, unit: str, metres: float) -> None:
    mesh = load_mesh(export(tmp_path, "stl", box(1.0 / metres)), unit)
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M, rtol=1e-5)
    assert note_with(mesh, "as given").startswith(f"Unit {unit} as given: 2.00 ×")


def test_metres_are_assumed_aloud_where_the_file_has_no_unit(tmp_path: Path) -> None:
    note = note_with(load_mesh(export(tmp_path, "stl", box())), "No unit")
    assert "taken as metres, 2.00 × 1.00 × 0.50 m; give --unit mm if that is wrong" in note


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_millimetres_without_a_unit_are_an_error_with_every_choice(
    tmp_path: Path, suffix: str
) -> None:
    with pytest.raises(RendezviewError, match="2291 m across") as caught:
        load_mesh(export(tmp_path, suffix, box(1000.0)))
    message = str(caught.value)
    assert "--unit" in message
    for choice in ("m: 2291 m", "cm: 22.91 m", "mm: 2.291 m", "in: 58.2 m", "ft: 698.4 m"):
        assert choice in message


def test_a_mesh_of_centimetres_without_a_unit_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RendezviewError, match=r"0\.0229.* m across"):
        load_mesh(export(tmp_path, "stl", box(0.01)))


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "mm"), (1000.0, "m")])
def test_a_given_unit_that_makes_no_sense_is_an_error(
    tmp_path: Path, scale: float, unit: str
) -> None:
    with pytest.raises(RendezviewError, match=f"Unit {unit} as given"):
        load_mesh(export(tmp_path, "stl", box(scale)), unit)


def test_unknown_unit_is_an_error_with_the_list(tmp_path: Path) -> None:
    with pytest.raises(RendezviewError, match=r"'furlong'.*ft"):
        load_mesh(tmp_path / "any.stl", "furlong")


def three_mf(path: Path, unit: str | None, scale: float) -> Path:
    """A tetrahedron with two base-material faces, one colour-group face and a plain one."""
    said = f' unit="{unit}"' if unit else ""
    corners = "".join(
        f'<vertex x="{x * scale}" y="{y * scale}" z="{z * scale}"/>'
        for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    model = (
        f'<?xml version="1.0"?><model{said} '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02" '
        'xmlns:m="http://schemas.microsoft.com/3dmanufacturing/material/2015/02"><resources>'
        '<basematerials id="5"><base name="gold" displaycolor="#FF8000"/>'
        '<base name="black" displaycolor="#000000FF"/></basematerials>'
        '<m:colorgroup id="6"><m:color color="#0000FF"/></m:colorgroup>'
        '<object id="1" type="model" pid="5" pindex="0"><mesh>'
        f"<vertices>{corners}</vertices><triangles>"
        '<triangle v1="0" v2="2" v3="1"/><triangle v1="0" v2="1" v3="3" pid="5" p1="1"/>'
        '<triangle v1="1" v2="2" v3="3" pid="6" p1="0"/>'
        '<triangle v1="0" v2="3" v3="2" pid="99" p1="0"/>'
        '</triangles></mesh></object></resources><build><item objectid="1" '
        f'transform="1 0 0 0 1 0 0 0 1 {5 * scale} 0 0"/></build></model>'
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)
    return path


@pytest.mark.parametrize(
    ("unit", "scale", "said"),
    [
        (None, 1000.0, "millimeters (3MF)"),
        ("centimeter", 100.0, "centimeters (3MF)"),
        ("inch", 1 / 0.0254, "inches (3MF)"),
        ("meter", 1.0, "meters (3MF)"),
    ],
)
def test_3mf_unit_and_build_transform_are_used(
    tmp_path: Path, unit: str | None, scale: float, said: str
) -> None:
    mesh = load_mesh(three_mf(tmp_path / "t.3mf", unit, scale))
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [5, 0, 0], atol=1e-9)
    np.testing.assert_allclose(mesh.extent_m, [1, 1, 1], atol=1e-9)
    assert said in note_with(mesh, "Unit from the file")


def test_given_unit_overrules_the_3mf_one_and_says_so(tmp_path: Path) -> None:
    mesh = load_mesh(three_mf(tmp_path / "t.3mf", None, 100.0), "cm")
    np.testing.assert_allclose(mesh.extent_m, [1, 1, 1], atol=1e-9)
    assert "not millimeters (3MF) as the file says" in note_with(mesh, "Unit cm as given")


def test_dae_unit_is_applied_once(tmp_path: Path) -> None:
    made = export(tmp_path, "dae", box(100.0))
    text = made.read_text()
    assert "</asset>" in text
    assert "<unit" not in text
    write(made, text.replace("</asset>", '<unit name="cm" meter="0.01"/></asset>'))
    mesh = load_mesh(made)
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M, atol=1e-6)
    assert "0.01 m (DAE)" in note_with(mesh, "Unit from the file")


def test_dae_without_a_unit_is_assumed_metres_aloud(tmp_path: Path) -> None:
    made = export(tmp_path, "dae", box())
    note_with(load_mesh(made), "No unit in the file")


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


def test_glb_base_colour_is_linear_already(tmp_path: Path) -> None:
    made = box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[0.2, 0.4, 0.8, 1.0])
    made.visual = trimesh.visual.TextureVisuals(material=material)
    mesh = load_mesh(export(tmp_path, "glb", made))
    np.testing.assert_allclose(mesh.face_rgb, np.tile([0.2, 0.4, 0.8], (12, 1)), atol=1e-6)


def test_dae_diffuse_is_srgb(tmp_path: Path) -> None:
    made = box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[0.2, 0.4, 0.8, 1.0])
    made.visual = trimesh.visual.TextureVisuals(material=material)
    mesh = load_mesh(export(tmp_path, "dae", made))
    np.testing.assert_allclose(mesh.face_rgb[3], linear_from_srgb([0.2, 0.4, 0.8]), atol=1e-6)


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


def checker(path: Path) -> Image.Image:
    """Left half red, right half blue."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4, 0] = 255
    pixels[:, 4:, 2] = 255
    image = Image.fromarray(pixels)
    image.save(path)
    return image


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
        "from rendezview.training.mesh import load_mesh\n"
        "mesh = load_mesh(Path(sys.argv[1]))\n"
        "print(len(mesh.faces), float(mesh.face_rgb.min()), *mesh.notes, sep='\\n')\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, str(path)],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0] == "2"
    assert float(lines[1]) == pytest.approx(GREY)
    assert sum("install Pillow" in line for line in lines) == 1


# --- OBJ ------------------------------------------------------------------------------


def obj(folder: Path, text: str) -> Mesh:
    return load_mesh(write(folder / "a.obj", text))


@pytest.mark.parametrize(
    "text",
    [
        TETRAHEDRON.rstrip(),
        TETRAHEDRON.replace("\n", "\r\n"),
        TETRAHEDRON.replace("\n", "\r"),
        TETRAHEDRON.replace(" ", "\t"),
        TETRAHEDRON.replace("v ", "   v ").replace("\n", " # said\n"),
        TETRAHEDRON.replace("f 1 3 2", "f 1 3 \\\n2"),
        "vn 0 0 1\n" + TETRAHEDRON.replace("f 1 3 2", "f 1//1 3//1 2//1"),
        "vt 0 0\n" + TETRAHEDRON.replace("f 1 3 2", "f 1/1 3/1 2/1"),
        "vt 0 0\nvn 0 0 1\n" + TETRAHEDRON.replace("f 1 3 2", "f 1/1/1 3/1/1 2/1/1"),
        TETRAHEDRON.replace("f 1 4 3", "f -4 -1 -2"),
        "mtllib gone.mtl\no part\ng group\ns off\nusemtl gold\n" + TETRAHEDRON,
    ],
    ids=["no newline at the end", "Windows", "old Mac", "tabs", "indented, comments",
         "continued line", "v//vn", "v/vt", "v/vt/vn", "negative", "statements"],
)  # fmt: skip
def test_obj_dialects_give_the_same_tetrahedron(tmp_path: Path, text: str) -> None:
    expected = triangles(obj(tmp_path, TETRAHEDRON))
    np.testing.assert_array_equal(triangles(obj(tmp_path, text)), expected)
    assert len(expected) == 4


def test_negative_obj_indices_count_back_from_their_own_line(tmp_path: Path) -> None:
    text = TRIANGLE + "f -3 -2 -1\n" + TRIANGLE.replace(" 0\n", " 5\n") + "f -3 -2 -1\n"
    mesh = obj(tmp_path, text)
    assert sorted(mesh.vertices_m[mesh.faces][:, :, 2].mean(axis=1)) == [0.0, 5.0]


def test_obj_polygons_are_cut_without_leaving_their_outline(tmp_path: Path) -> None:
    arrow = "v 0 0 0\nv 2 1 0\nv 0 2 0\nv 1 1 0\nf 1 2 3 4\n"  # concave at the last corner
    mesh = obj(tmp_path, arrow)
    corner = mesh.vertices_m[mesh.faces]
    twice = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (twice[:, 2] > 0).all()  # winding kept, none flipped
    assert twice[:, 2].sum() == pytest.approx(2.0)  # twice the arrow's area of 1
    note_with(mesh, "1 polygon with more than three corners cut into triangles, 1 of them concave")


@pytest.mark.parametrize("seed", range(20))
def test_star_polygons_are_cut_into_exactly_their_area(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 30))
    angle = np.sort(rng.uniform(0, 2 * np.pi, count))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.1 * np.diff(angle, append=7).clip(
        0, 0.1
    )
    radius = rng.uniform(0.2, 1.0, count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)
    turn = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))[:3, :3]
    corners = flat @ turn.T + 100.0
    cut, _ = triangulate(corners)
    after = np.roll(flat, -1, axis=0)
    area = 0.5 * (flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0]).sum()
    parts = corners[np.array(cut)]
    normals = np.cross(parts[:, 1] - parts[:, 0], parts[:, 2] - parts[:, 0]) @ turn[:, 2]
    assert len(cut) == count - 2
    assert normals.min() > -1e-9
    assert 0.5 * normals.sum() == pytest.approx(area, rel=1e-6)


def test_obj_lines_and_short_faces_are_ignored_and_counted(tmp_path: Path) -> None:
    mesh = obj(tmp_path, TETRAHEDRON + "l 1 2 3\np 1\nf 1 2\n")
    assert len(mesh.faces) == 4
    note_with(mesh, "2 line or point elements ignored")
    note_with(mesh, "1 face with fewer than three corners ignored")


def test_missing_obj_material_library_is_noted_once(tmp_path: Path) -> None:
    mesh = obj(tmp_path, "mtllib gone.mtl\nmtllib gone.mtl\nusemtl a\n" + TETRAHEDRON)
    note_with(mesh, "gone.mtl not found beside the mesh: faces are grey")
    assert not any("No usable" in note for note in mesh.notes)


def test_obj_materials_colour_their_faces(tmp_path: Path) -> None:
    write(tmp_path / "two words.mtl", "newmtl red\r\n\tKd 0.5 0 0\r\nnewmtl dark\r\nKd 0.25\r\n")
    head, _, tail = TETRAHEDRON.partition("f 1 3 2\n")
    text = "mtllib two words.mtl\n" + head + "f 1 3 2\nusemtl red\nf 1 2 4\nusemtl dark\n"
    mesh = obj(tmp_path, text + tail.replace("f 1 2 4\n", "") + "usemtl none\nf 1 2 3\n")
    expected = [[GREY] * 3, linear_from_srgb([0.5, 0, 0]), *[linear_from_srgb([0.25] * 3)] * 2]
    np.testing.assert_allclose(mesh.face_rgb[:4], expected, atol=1e-6)
    note_with(mesh, "1 material not defined (none)")


@pytest.mark.parametrize("full", [1, 255])
def test_obj_vertex_colours_of_either_range(tmp_path: Path, full: int) -> None:
    text = TRIANGLE.replace(" 0\n", f" 0 {full} 0 0\n") + "f 1 2 3\n"
    np.testing.assert_allclose(obj(tmp_path, text).face_rgb, [[1, 0, 0]], atol=1e-6)


def test_huge_obj_vertex_colours_are_ignored_with_a_note(tmp_path: Path) -> None:
    mesh = obj(tmp_path, TRIANGLE.replace(" 0\n", " 0 65535 1e9 0\n") + "f 1 2 3\n")
    np.testing.assert_allclose(mesh.face_rgb, GREY)
    note_with(mesh, "Vertex colours ignored")


@pytest.mark.parametrize("face", ["f 1 2 9", "f 0 1 2", "f -9 1 2"])
def test_obj_face_with_a_missing_vertex_names_the_line(tmp_path: Path, face: str) -> None:
    with pytest.raises(RendezviewError, match=r"a\.obj, line 4: .*vertex that is not there"):
        obj(tmp_path, TRIANGLE + face + "\n")


@pytest.mark.parametrize("line", ["v 1 2", "v 1 2 x", "f a b c", "f 1.5 2 3"])
def test_unreadable_obj_line_is_named(tmp_path: Path, line: str) -> None:
    with pytest.raises(RendezviewError, match="line 4"):
        obj(tmp_path, TRIANGLE + line + "\n")


# --- cleaning -------------------------------------------------------------------------


def test_degenerate_and_nan_faces_are_dropped_and_counted(tmp_path: Path) -> None:
    text = TETRAHEDRON + "v nan 0 0\nv 2 0 0\nv 9 9 9\nf 1 2 5\nf 1 1 2\nf 1 2 6\n"
    mesh = obj(tmp_path, text)
    assert len(mesh.faces) == 4
    assert len(mesh.vertices_m) == 4  # nan, (2 0 0) and the unused one are gone
    note_with(mesh, "1 face with a coordinate that is not a usable number dropped")
    note_with(mesh, "2 faces without area dropped")


def test_equal_vertices_are_merged_also_over_signed_zero(tmp_path: Path) -> None:
    mesh = obj(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nv -0.0 0 0\nv 1 0 0\nv 0 -1 0\n"
               "f 1 2 3\nf 5 4 6\n")  # fmt: skip
    assert len(mesh.vertices_m) == 4
    note_with(mesh, "4 open edges")


def test_open_edges_and_mixed_winding_are_noted_not_refused(tmp_path: Path) -> None:
    opened = obj(tmp_path, TETRAHEDRON.replace("f 1 4 3\n", ""))
    assert note_with(opened, "watertight") == ("Not watertight: 3 open edges; fine for rendering.")
    flipped = obj(tmp_path, TETRAHEDRON.replace("f 1 4 3", "f 1 3 4"))
    assert "3 edges face opposite ways" in note_with(flipped, "Mixed winding")


def test_the_library_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for suffix in FORMATS:
        load_mesh(export(tmp_path, suffix, box(100.0)), "cm")
    bad = write(tmp_path / "bad.glb", b"glTF" + bytes(40))
    with pytest.raises(RendezviewError):
        load_mesh(bad)
    assert capfd.readouterr() == ("", "")


# --- bounding sphere ------------------------------------------------------------------


def test_bounding_sphere_of_a_box_is_its_half_diagonal(tmp_path: Path) -> None:
    centre, radius = load_mesh(export(tmp_path, "obj", box())).bounding_sphere
    np.testing.assert_allclose(centre, [3.0, -1.0, 0.25], atol=1e-6)
    assert radius == pytest.approx(np.linalg.norm(EXTENT_M) / 2)


def test_bounding_sphere_leaves_out_vertices_no_face_uses() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [50, 50, 50]])
    mesh = Mesh(vertices, np.array([[0, 1, 2]], np.int32), np.zeros((1, 3), np.float32), ())
    assert mesh.bounding_sphere[1] == pytest.approx(np.sqrt(0.5))
    np.testing.assert_array_equal(mesh.extent_m, [1, 1, 0])


@pytest.mark.parametrize("seed", range(30))
def test_sphere_encloses_all_and_cannot_be_smaller(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(int(rng.integers(2, 300)), 3)) * rng.uniform(0.01, 5, 3) + 40.0
    if seed % 5 == 0:
        points[:, 2] = 1.0  # flat
    centre, radius = smallest_enclosing_sphere(points)
    distance = np.linalg.norm(points - centre, axis=1)
    assert distance.max() <= radius
    # Optimal: the centre lies in the convex hull of the points on the sphere, so no step
    # of the centre brings all of them nearer.
    touching = points[distance > radius * (1 - 1e-9)] - centre
    assert len(touching) >= 2
    for step in rng.normal(size=(200, 3)):
        assert (touching @ step).min() <= 1e-8 * radius * np.linalg.norm(step)


# --- errors ---------------------------------------------------------------------------


def test_missing_file_folder_and_empty_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(RendezviewError, match=r"gone\.stl does not exist"):
        load_mesh(tmp_path / "gone.stl")
    with pytest.raises(RendezviewError, match="is a folder"):
        load_mesh(tmp_path)
    with pytest.raises(RendezviewError, match="is empty"):
        load_mesh(write(tmp_path / "empty.stl", ""))


@pytest.mark.parametrize("name", ["model.step", "model.xyz", "model"])
def test_unsupported_format_lists_the_supported_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(RendezviewError, match=r"\.stl, \.obj, \.ply, \.glb, \.gltf, \.3mf, \.dae"):
        load_mesh(write(tmp_path / name, "x"))


@pytest.mark.parametrize("suffix", ["stl", "ply", "glb", "3mf"])
@pytest.mark.parametrize("keep", [0.3, 0.9, 0.99])
def test_truncated_binary_is_an_error(tmp_path: Path, suffix: str, keep: float) -> None:
    made = export(tmp_path, suffix, box(1000.0 if suffix == "3mf" else 1.0))
    content = made.read_bytes()
    with pytest.raises(RendezviewError, match=f"mesh.{suffix}"):
        load_mesh(write(made, content[: int(len(content) * keep)]))


def test_truncated_text_stl_is_an_error(tmp_path: Path) -> None:
    text = trimesh.exchange.stl.export_stl_ascii(box())
    with pytest.raises(RendezviewError, match="cut short"):
        load_mesh(write(tmp_path / "a.stl", text[: len(text) // 2]))


def test_truncated_stl_says_how_many_triangles_are_announced(tmp_path: Path) -> None:
    made = export(tmp_path, "stl", box())
    with pytest.raises(RendezviewError, match=r"announces 12 triangles \(684 bytes\).*600 bytes"):
        load_mesh(write(made, made.read_bytes()[:600]))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_picture_with_a_mesh_suffix_is_an_error(tmp_path: Path, suffix: str) -> None:
    checker(tmp_path / "a.png")
    with pytest.raises(RendezviewError, match=f"a.{suffix}"):
        load_mesh((tmp_path / "a.png").rename(tmp_path / f"a.{suffix}"))


@pytest.mark.parametrize("suffix", FORMATS)
def test_text_with_a_mesh_suffix_is_an_error(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(RendezviewError, match=f"a.{suffix}"):
        load_mesh(write(tmp_path / f"a.{suffix}", "just some words\n" * 20))


def test_point_clouds_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(RendezviewError, match=r"no triangles.*cloud of points"):
        obj(tmp_path, TRIANGLE)
    with pytest.raises(RendezviewError, match="no triangles"):
        load_mesh(export(tmp_path, "ply", trimesh.PointCloud([[0, 0, 0], [1, 1, 1]])))


def test_a_mesh_without_any_area_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RendezviewError, match="none of its 2 faces has an area"):
        obj(tmp_path, "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 1\n")


@pytest.mark.parametrize("value", ["nan", "inf", "-1e300"])
def test_a_mesh_without_numbers_is_an_error(tmp_path: Path, value: str) -> None:
    with pytest.raises(RendezviewError, match="every face"):
        obj(tmp_path, f"v {value} 0 0\nv 0 {value} 0\nv 0 0 {value}\nf 1 2 3\n")


def test_gigantic_meshes_are_refused_before_they_are_read(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement face 20000001\nend_header\n"
    with pytest.raises(RendezviewError, match=r"20000001 triangles.*simplify"):
        load_mesh(write(tmp_path / "a.ply", header))


def test_too_many_faces_or_bytes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_module, "MAX_FACES", 11)
    with pytest.raises(RendezviewError, match="12 triangles"):
        load_mesh(export(tmp_path, "glb", box()))
    with pytest.raises(RendezviewError, match="12 triangles"):
        load_mesh(export(tmp_path, "stl", box()))
    monkeypatch.setattr(mesh_module, "MAX_FILE_BYTES", 100)
    with pytest.raises(RendezviewError, match="GiB"):
        load_mesh(export(tmp_path, "stl", box()))


# --- meshes as users have them --------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "faces", "extent_m", "missing"),
    [
        ("meshes_42/Cubesat_6U.obj", 448, [0.1, 0.2, 0.3], "42.mtl"),
        ("meshes_42/HST.obj", 7658, [11.64, 12.73, 13.35], "HST.mtl"),
        ("meshes_42/ISS_MainBody.obj", 6920, [49.25, 51.80, 20.98], "ISS.mtl"),
        ("meshes_42/IonCruiser.obj", 180, [1.85, 18.00, 2.21], "42.mtl"),
        ("meshes_42/Kepler.obj", 372, [4.70, 1.98, 1.71], "Kepler.mtl"),
        ("meshes_42/SpaceShuttleOrbiter.obj", 11582, [35.84, 23.30, 13.28], "Orbiter.mtl"),
        ("tango/tango.obj", 10732, [1.10, 1.07, 0.41], None),
    ],
)
def test_public_spacecraft_models_load_with_readable_notes(
    name: str, faces: int, extent_m: list[float], missing: str | None
) -> None:
    folder = os.environ.get("RENDEZVIEW_TEST_DATA")
    if not folder or not (Path(folder) / name).exists():
        pytest.skip("RENDEZVIEW_TEST_DATA does not name a folder with " + name)
    mesh = load_mesh(Path(folder) / name)
    assert len(mesh.faces) == faces
    np.testing.assert_allclose(mesh.extent_m, extent_m, atol=0.006)
    centre, radius = mesh.bounding_sphere
    assert np.linalg.norm(mesh.vertices_m - centre, axis=1).max() <= radius
    assert max(extent_m) / 2 <= radius * 1.01
    note_with(mesh, "No unit in the file")
    if missing:
        note_with(mesh, missing)
    assert all(note[0] == note[0].upper() and note.endswith(".") for note in mesh.notes)
