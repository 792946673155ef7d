"""Mesh files of every format become one clean mesh in metres, or a plain error."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.ground.mesh.mesh_samples import (
    EXTENT_M,
    FORMATS,
    TETRAHEDRON,
    TRIANGLE,
    box,
    checker,
    export,
    note_with,
    obj,
    three_mf,
    triangles,
    write,
)

from rendezview.errors import RendezviewError
from rendezview_ground.mesh import mesh as mesh_module
from rendezview_ground.mesh.bounding_sphere import smallest_enclosing_sphere
from rendezview_ground.mesh.mesh import Mesh, load_mesh

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


@pytest.mark.parametrize("suffix", ["stl", "dae"])
def test_metres_are_assumed_aloud_where_the_file_has_no_unit(tmp_path: Path, suffix: str) -> None:
    note = note_with(load_mesh(export(tmp_path, suffix, box())), "No unit in the file")
    assert "taken as metres, 2.00 × 1.00 × 0.50 m; give --unit mm if that is wrong" in note


@pytest.mark.requirement("RV-MESH-1")
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
    assert "not millimeters (3MF) as the file states" in note_with(mesh, "Unit cm as given")


def test_dae_unit_is_applied_once(tmp_path: Path) -> None:
    made = export(tmp_path, "dae", box(100.0))
    text = made.read_text()
    assert "</asset>" in text
    assert "<unit" not in text
    write(made, text.replace("</asset>", '<unit name="cm" meter="0.01"/></asset>'))
    mesh = load_mesh(made)
    np.testing.assert_allclose(mesh.extent_m, EXTENT_M, atol=1e-6)
    assert "0.01 m (DAE)" in note_with(mesh, "Unit from the file")


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


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("model.iges", "export it from the CAD program as STEP"),
        ("model.SLDPRT", "export it from the CAD program as STEP"),
        ("model.fbx", r"import it in Blender, check its size and axes, .* glTF \(GLB\)"),
        ("model.3ds", "import it in Blender"),
        ("model.wrl", "import it in Blender"),
        ("model.xyz", "export the model as one of them"),
        ("model", "export the model as one of them"),
    ],
)
def test_unsupported_format_lists_the_supported_ones_and_the_way_there(
    tmp_path: Path, name: str, advice: str
) -> None:
    with pytest.raises(RendezviewError, match=rf"\.stl, \.obj, \.ply, \.off, .*: {advice}"):
        load_mesh(write(tmp_path / name, "x"))


@pytest.mark.parametrize("suffix", ["stl", "ply", "glb", "3mf"])
@pytest.mark.parametrize("keep", [0.3, 0.9, 0.99])
def test_truncated_binary_is_an_error(tmp_path: Path, suffix: str, keep: float) -> None:
    made = export(tmp_path, suffix, box(1000.0 if suffix == "3mf" else 1.0))
    content = made.read_bytes()
    with pytest.raises(RendezviewError, match=f"mesh.{suffix}"):
        load_mesh(write(made, content[: int(len(content) * keep)]))


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


@pytest.mark.parametrize(
    ("scale", "across", "likely"),
    [(43.5, "99.67", "cm or in or ft"), (30.0, "68.74", "cm or in or ft")],
)
def test_a_size_of_stations_is_asked_about_unless_the_unit_is_given(
    tmp_path: Path, scale: float, across: str, likely: str
) -> None:
    path = export(tmp_path, "stl", box(scale))
    mesh = load_mesh(path)
    (doubt,) = mesh.doubts
    assert doubt.startswith(f"{across} m across is the size of a space station")
    assert f"{likely} would be a spacecraft" in doubt
    assert doubt in mesh.notes
    assert load_mesh(path, "m").doubts == ()


@pytest.mark.parametrize("size", [100.0, 226.3, 340.5])
def test_a_cubesat_in_millimetres_is_refused_with_the_likely_units(
    tmp_path: Path, size: float
) -> None:
    path = export(tmp_path, "stl", trimesh.creation.box((100.0, 100.0, size)))
    with pytest.raises(RendezviewError, match="mm or in would be a spacecraft"):
        load_mesh(path)
    assert load_mesh(path, "mm").extent_m.max() == pytest.approx(1e-3 * size)
