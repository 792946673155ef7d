"""What `rendezview doctor` finds in meshes whose faults are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from tests.ground.evaluate.figures import pixels

from rendezview.io.sequences import open_sequence
from rendezview_ground.evaluate.doctor import (
    Diagnosis,
    Finding,
    Mark,
    diagnose,
    of_frames,
    of_look_alikes,
)
from rendezview_ground.evaluate.doctor_command import doctor
from rendezview_ground.evaluate.pictures.doctor_pictures import doctor_picture
from rendezview_ground.mesh.mesh import load_mesh


def examined(part: trimesh.Trimesh, folder: Path) -> Diagnosis:
    part.export(folder / "part.stl")
    return diagnose(load_mesh(folder / "part.stl", "m"))


def finding(diagnosis: Diagnosis, words: str) -> Finding:
    (found,) = [f for f in diagnosis.findings if words in f.what]
    return found


def body() -> trimesh.Trimesh:
    bump = trimesh.creation.box((0.4, 0.5, 0.9)).apply_translation((0.7, 0.3, 0.7))
    return trimesh.util.concatenate([trimesh.creation.box((2.0, 1.2, 0.8)), bump])


def test_a_closed_body_needs_nothing(tmp_path: Path) -> None:
    diagnosis = examined(body(), tmp_path)
    assert diagnosis.healthy
    assert finding(diagnosis, "surface is closed").mark is Mark.FINE
    assert not diagnosis.far_faces.any()
    assert len(diagnosis.open_edges) == len(diagnosis.mixed_edges) == 0


def test_open_edges_and_mixed_winding_are_found_where_they_are(tmp_path: Path) -> None:
    part = body()
    part.update_faces(np.arange(len(part.faces)) != 0)
    diagnosis = examined(part, tmp_path)
    assert len(diagnosis.open_edges) == 3
    assert finding(diagnosis, "3 open edges").mark is Mark.NOTE
    part = body()
    part.faces[5] = part.faces[5][::-1]
    diagnosis = examined(part, tmp_path)
    assert len(diagnosis.mixed_edges) == 3
    assert "opposite directions at 3 edges" in finding(diagnosis, "opposite").what
    assert diagnosis.healthy


def test_a_craft_that_looks_nearly_the_same_from_two_sides_is_told(tmp_path: Path) -> None:
    wings = trimesh.creation.box((0.6, 5.0, 0.05))
    mast = trimesh.creation.box((0.1, 0.1, 0.5)).apply_translation((0.4, 0.3, 0.6))
    craft = trimesh.util.concatenate([trimesh.creation.box((1.2, 1.2, 1.0)), wings, mast])
    craft.export(tmp_path / "part.stl")
    (found,) = of_look_alikes(load_mesh(tmp_path / "part.stl", "m"), ())
    assert "looks nearly the same" in found.what
    assert found.mark is Mark.NOTE
    assert "180° about" in found.what
    assert "ambiguous" in found.cost


def test_a_datum_plane_is_named_with_what_it_costs(tmp_path: Path) -> None:
    floor = trimesh.creation.box((12.0, 12.0, 0.01)).apply_translation((0.0, 0.0, -1.0))
    craft = trimesh.creation.icosphere(2, radius=1.0)
    diagnosis = examined(trimesh.util.concatenate([craft, floor]), tmp_path)
    found = finding(diagnosis, "times larger")
    assert found.mark is Mark.ACT
    assert "12 triangles" in found.what
    assert not diagnosis.healthy
    assert diagnosis.far_faces.sum() == 12
    with_floor = doctor_picture(diagnosis, "floor")
    assert "suspicious body: 12 faces" in {
        text.get_text() for legend in with_floor.legends for text in legend.get_texts()
    }


@pytest.mark.parametrize(("sections", "mark"), [(16, Mark.ACT), (48, Mark.NOTE), (200, Mark.FINE)])
def test_facets_are_as_deep_as_those_of_a_cylinder(
    tmp_path: Path, sections: int, mark: Mark
) -> None:
    diagnosis = examined(trimesh.creation.cylinder(1.0, 2.0, sections=sections), tmp_path)
    found = finding(diagnosis, "Facets of curved")
    depth_mm = 1e3 * (1.0 - np.cos(np.pi / sections))
    assert float(found.what.split(" are ")[1].split(" mm")[0]) == pytest.approx(depth_mm, rel=0.1)
    assert found.mark is mark


def test_hidden_parts_are_counted(tmp_path: Path) -> None:
    inside = trimesh.creation.box((1.7, 1.0, 0.6))
    diagnosis = examined(trimesh.util.concatenate([body(), inside]), tmp_path)
    assert "(14 faces)" in finding(diagnosis, "never seen from outside").what


def test_a_symmetric_body_is_told(tmp_path: Path) -> None:
    diagnosis = examined(trimesh.creation.box((2.0, 1.2, 0.8)), tmp_path)
    (turned,) = [f for f in diagnosis.findings if "looks the same when turned by 180°" in f.what]
    assert "4 attitudes" in turned.what
    assert "through" not in turned.what
    corner = trimesh.creation.box((2.0, 1.2, 0.8))
    corner.apply_translation([1.0, 0.6, 0.4])
    moved = finding(examined(corner, tmp_path), "looks the same when turned by 180°")
    assert "4 attitudes; the axes pass through (1.00, 0.60, 0.40) m" in moved.what
    assert not any("looks the same" in f.what for f in examined(body(), tmp_path).findings)


def test_the_command_prints_the_findings_and_draws_the_mesh(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body().export(tmp_path / "part.stl")
    doctor(str(tmp_path / "part.stl"), tmp_path / "part.png", "m")
    said = capsys.readouterr()
    assert "surface is" in said.out
    assert "nothing needs to be done" in said.err
    picture = cv2.imread(str(tmp_path / "part.png"))
    assert picture.shape[0] > 900
    assert picture.std() > 10.0


def test_open_edges_are_drawn_only_where_they_are_seen(tmp_path: Path) -> None:
    part = trimesh.creation.box((2.0, 1.2, 0.8))
    top = part.face_normals[:, 2] < 0.5
    part.update_faces(top)
    drawn = pixels(doctor_picture(examined(part, tmp_path), "open"))
    orange = (np.abs(drawn.astype(int) - (230, 159, 0)) < 25).all(axis=2)
    upper, lower = orange[: len(orange) // 2].sum(), orange[len(orange) // 2 : -60]
    assert upper > 500  # both upper views look into the opening
    assert lower[:, lower.shape[1] // 2 :].sum() < 0.3 * upper


def test_doubled_faces_are_counted(tmp_path: Path) -> None:
    diagnosis = examined(trimesh.util.concatenate([body(), body()]), tmp_path)
    assert finding(diagnosis, "24 faces of the same three corners").mark is Mark.NOTE


@pytest.mark.parametrize("sides", [6, 10, 12])
def test_flat_sides_are_no_coarse_export(tmp_path: Path, sides: int) -> None:
    trimesh.creation.cylinder(1.0, 3.0, sections=sides).export(tmp_path / "part.stl")
    found = [f for f in diagnose(load_mesh(tmp_path / "part.stl")).findings if "acets" in f.what]
    assert all(f.mark is Mark.NOTE for f in found)
    assert all("none if the craft is built of flat sides" in f.cost for f in found)
    assert len(found) == (sides > 8)  # sharper bends are edges


def test_what_is_odd_about_frames_is_marked(tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(
        '{"width": 64, "height": 48, "fx": 60, "fy": 90, "cx": 31, "cy": 23}'
    )
    images = [Image.new("L", (64, 48), grey) for grey in (9, 90)]
    images[0].save(tmp_path / "a.webp", save_all=True, append_images=images[1:])
    camera, page = of_frames(open_sequence(tmp_path))
    assert (camera.mark, page.mark) == (Mark.ACT, Mark.NOTE)
    assert "fx 60 and fy 90 differ" in camera.what
    assert "2 pictures each" in page.what


def test_a_mesh_of_the_size_of_a_station_is_to_be_acted_on(tmp_path: Path) -> None:
    trimesh.creation.box((90.0, 30.0, 20.0)).export(tmp_path / "part.stl")
    diagnosis = diagnose(load_mesh(tmp_path / "part.stl"))
    assert not diagnosis.healthy
    assert any("size of a space station" in f.what for f in diagnosis.findings)
