"""Text of mesh files as programs write it: byte order marks, Latin-1, ends, commas, names."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.ground.mesh.mesh_samples import (
    EXTENT_M,
    TETRAHEDRON,
    box,
    checker,
    export,
    note_with,
    write,
)

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.mesh import load_mesh

TEXT_STL = trimesh.exchange.stl.export_stl_ascii(box())
MARKS = {"utf-8-sig": 0, "utf-16": 0, "utf-16-le": 0xFEFF, "utf-16-be": 0xFEFF}


def encoded(text: str, encoding: str) -> bytes:
    mark = chr(MARKS[encoding]) if MARKS.get(encoding) else ""
    return (mark + text).encode(encoding)


@pytest.mark.parametrize("encoding", MARKS)
@pytest.mark.parametrize("first", ["", "v 9 9 9\n", "# Würfel\n"])
def test_a_byte_order_mark_hides_no_vertex_of_an_obj_file(
    tmp_path: Path, encoding: str, first: str
) -> None:
    plain = load_mesh(write(tmp_path / "plain.obj", first + TETRAHEDRON))
    marked = load_mesh(write(tmp_path / "marked.obj", encoded(first + TETRAHEDRON, encoding)))
    np.testing.assert_array_equal(marked.vertices_m, plain.vertices_m)
    np.testing.assert_array_equal(marked.faces, plain.faces)


@pytest.mark.parametrize("encoding", ["latin-1", "cp1252", "utf-8", *MARKS])
def test_a_text_stl_is_read_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    text = TEXT_STL.replace("solid", "solid Träger-Gehäuse", 1)
    mesh = load_mesh(write(tmp_path / "a.stl", encoded(text, encoding)))
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M)


@pytest.mark.parametrize("key", ["o Träger", "g Flügel", "# Höhe", "usemtl Weiß"])
def test_an_obj_file_in_latin_1_is_read(tmp_path: Path, key: str) -> None:
    mesh = load_mesh(write(tmp_path / "a.obj", f"{key}\n{TETRAHEDRON}".encode("latin-1")))
    assert len(mesh.faces) == 4


@pytest.mark.parametrize(
    "end", ["endsolid", "end solid", "end solid box", "ENDSOLID", "EndSolid\n"]
)
def test_a_text_stl_ends_as_programs_write_it(tmp_path: Path, end: str) -> None:
    text = TEXT_STL[: TEXT_STL.rindex("endsolid")]
    assert len(load_mesh(write(tmp_path / "a.stl", text + end)).faces) == 12
    with pytest.raises(RendezviewError, match="cut short"):
        load_mesh(write(tmp_path / "a.stl", text))


@pytest.mark.parametrize("tail", [b"\0", b"\r\n", b"made by a printer", bytes(500)])
def test_bytes_behind_a_binary_stl_are_counted(tmp_path: Path, tail: bytes) -> None:
    content = trimesh.exchange.stl.export_stl(box())
    mesh = load_mesh(write(tmp_path / "a.stl", content + tail))
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M)
    assert note_with(mesh, "behind the last triangle").startswith(f"{len(tail)} byte")
    said = r"announces 12 triangles \(684 bytes\) but the file has 683 bytes"
    with pytest.raises(RendezviewError, match=said):
        load_mesh(write(tmp_path / "a.stl", content[:-1]))


def test_a_text_stl_of_other_than_triangles_is_refused(tmp_path: Path) -> None:
    lines = TEXT_STL.split("\n")
    corner = next(line for line in lines if "vertex" in line)
    lines.insert(lines.index(corner), corner)
    with pytest.raises(RendezviewError, match="37 vertices in 12 facets"):
        load_mesh(write(tmp_path / "a.stl", "\n".join(lines)))


def test_vertices_that_are_no_numbers_are_dropped_without_a_warning(tmp_path: Path) -> None:
    content = bytearray(trimesh.exchange.stl.export_stl(box()))
    content[96:100] = np.float32(np.nan).tobytes()
    content[146:150] = np.float32(np.inf).tobytes()
    mesh = load_mesh(write(tmp_path / "a.stl", bytes(content)))
    assert len(mesh.faces) == 10
    made = box()
    made.vertices[0] = np.nan
    content = trimesh.exchange.ply.export_ply(made, encoding="ascii")
    assert 0 < len(load_mesh(write(tmp_path / "a.ply", content)).faces) < 12


def test_decimal_commas_are_read_as_points(tmp_path: Path) -> None:
    plain = load_mesh(write(tmp_path / "a.obj", TETRAHEDRON.replace("1", "1.5", 2)))
    commas = load_mesh(write(tmp_path / "b.obj", TETRAHEDRON.replace("1", "1,5", 2)))
    np.testing.assert_array_equal(commas.vertices_m, plain.vertices_m)
    assert note_with(commas, "Decimal commas")
    text = TEXT_STL.replace(".", ",")
    assert note_with(load_mesh(write(tmp_path / "a.stl", text)), "Decimal commas")
    with pytest.raises(RendezviewError, match="line 1: cannot read"):
        load_mesh(write(tmp_path / "c.obj", "v 0,1,2\n" + TETRAHEDRON))


@pytest.mark.parametrize(
    ("stored", "named"),
    [
        ("my paint.mtl", "my\\ paint.mtl"),
        ("my paint.mtl", "my%20paint.mtl"),
        ("my paint.mtl", '"my paint.mtl"'),
        ("Weiß.mtl", "Weiß.mtl"),
        ("a%20b.mtl", "a%20b.mtl"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_names_of_materials_are_found_as_they_are_escaped(
    tmp_path: Path, stored: str, named: str, encoding: str
) -> None:
    write(tmp_path / stored, "newmtl red\nKd 1 0 0\n".encode(encoding))
    content = f"mtllib {named}\nusemtl red\n{TETRAHEDRON}"
    mesh = load_mesh(write(tmp_path / "a.obj", content.encode("utf-8")))
    np.testing.assert_allclose(mesh.face_rgb, np.tile([1.0, 0.0, 0.0], (4, 1)))


def test_a_texture_with_an_escaped_name_is_found(tmp_path: Path) -> None:
    checker(tmp_path / "my skin.png")
    write(tmp_path / "a.mtl", "newmtl skin\nmap_Kd my\\ skin.png\n")
    faces = "usemtl skin\nvt 0.1 0.5\nf 1/1 3/1 2/1\nusemtl none\nf 1 2 4\n"
    mesh = load_mesh(write(tmp_path / "a.obj", f"mtllib a.mtl\n{TETRAHEDRON[:32]}{faces}"))
    np.testing.assert_allclose(mesh.face_rgb[0], [1.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
@pytest.mark.parametrize("comment", ["Höhe".encode("latin-1"), "Höhe".encode(), b"\xff\xfe"])
def test_comments_of_a_ply_file_may_be_in_any_encoding(
    tmp_path: Path, encoding: str, comment: bytes
) -> None:
    content = trimesh.exchange.ply.export_ply(box(), encoding=encoding)
    content = content.replace(b" 1.0\n", b" 1.0\ncomment " + comment + b"\n", 1)
    np.testing.assert_allclose(load_mesh(write(tmp_path / "a.ply", content)).extent_m, EXTENT_M)


@pytest.mark.parametrize("suffix", ["gltf", "dae", "ply"])
def test_a_byte_order_mark_is_no_part_of_other_formats(tmp_path: Path, suffix: str) -> None:
    options = {"encoding": "ascii"} if suffix == "ply" else {}
    path = export(tmp_path, suffix, box(), **options)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    np.testing.assert_allclose(load_mesh(path).extent_m, EXTENT_M, atol=1e-6)


VERTICES = [(x, y, z) for x in (0, 2) for y in (0, 4) for z in (0, 1)]
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
PLACES = "".join("{} {} {}\n".format(*vertex) for vertex in VERTICES)
QUADS = "".join("4 {} {} {} {}\n".format(*side) for side in SIDES)
TRIANGLES = "".join(f"3 {a} {b} {c}\n3 {a} {c} {d}\n" for a, b, c, d in SIDES)


@pytest.mark.parametrize(
    "text",
    [
        f"OFF\n8 12 18\n{PLACES}{TRIANGLES}",
        f"OFF 8 12 0\n{PLACES}{TRIANGLES}",
        f"OFF8 12 0\n{PLACES}{TRIANGLES}",
        f"OFF\n8 12\n{PLACES}{TRIANGLES}",
        f"OFF\n8 6 0\n{PLACES}{QUADS}",
        f"# by a program\nOFF\n# 2 × 4 × 1\n8 12 0 # counts\n\n{PLACES}# faces\n{TRIANGLES}",
        f"OFF\n8 12 0\n{PLACES}{TRIANGLES}".replace("\n", "\r\n"),
        "OFF\n8 6 0\n" + PLACES + QUADS.replace("\n", " 255 0 0\n"),
        "COFF\n8 12 0\n" + PLACES.replace("\n", " 255 0 0 255\n") + TRIANGLES,
        "NOFF\n8 12 0\n" + PLACES.replace("\n", " 0 0 1\n") + TRIANGLES,
    ],
)
def test_off_files_are_read_as_programs_write_them(tmp_path: Path, text: str) -> None:
    mesh = load_mesh(write(tmp_path / "a.off", text))
    np.testing.assert_allclose(mesh.extent_m, (2.0, 4.0, 1.0))
    assert len(mesh.faces) == 12


def test_an_off_file_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    whole = f"OFF\n8 12 0\n{PLACES}{TRIANGLES}"
    with pytest.raises(RendezviewError, match="12 faces are announced, 11 are there"):
        load_mesh(write(tmp_path / "a.off", whole[: whole.rindex("3 ")]))


@pytest.mark.parametrize("metre", ["1", "1.000000", "0.01"])
def test_decimal_commas_of_a_collada_file_are_points(tmp_path: Path, metre: str) -> None:
    plain = export(tmp_path, "dae", box(1.0 / float(metre))).read_text()
    unit = f'<asset><unit meter="{float(metre):f}"/>'
    pointed = plain.replace("<asset>", unit) if "<unit" not in plain else plain
    pointed = re.sub(r"<unit [^>]*/?>", f'<unit name="u" meter="{float(metre):f}"/>', pointed)
    commas = re.sub(r"(?<=\d)\.(?=\d)", ",", pointed).replace("1,0 encod", "1.0 encod")
    commas = re.sub(r'(version=["\']\d),', r"\1.", commas).replace("1,4,1", "1.4.1")
    assert "0," in commas
    mesh = load_mesh(write(tmp_path / "b.dae", commas))
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M, rtol=1e-5)
    assert note_with(mesh, "Decimal commas")


def test_a_3mf_file_with_its_bodies_in_other_parts_is_named(tmp_path: Path) -> None:
    made = export(tmp_path, "3mf", box(1000.0))
    with zipfile.ZipFile(made) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "b.3mf", "w") as archive:
        for name, content in parts.items():
            if name.lower().endswith("3dmodel.model"):
                content = re.sub(
                    rb"<item ", b'<item xmlns:q="http://schemas.microsoft.com/3dmanufacturing/'
                    b'production/2015/06" q:path="/3D/Objects/a.model" ', content
                )  # fmt: skip
            archive.writestr(name, content)
    with pytest.raises(
        RendezviewError, match=r"b\.3mf: its bodies are in other parts .* as one 3MF"
    ):
        load_mesh(tmp_path / "b.3mf")
