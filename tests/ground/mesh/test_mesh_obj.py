"""Wavefront OBJ files: dialects, polygons, materials, errors by line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.ground.mesh.mesh_samples import TETRAHEDRON, TRIANGLE, note_with, obj, triangles, write

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.colours import GREY, linear_from_srgb
from rendezview_ground.mesh.polygon import triangulate

# --- OBJ ------------------------------------------------------------------------------


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
