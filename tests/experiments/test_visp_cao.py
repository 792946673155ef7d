"""A mesh as ViSP's tracker wants it: planar faces, creases, closed borders."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import trimesh

from experiments.peers.visp_cao import Cao, CaoOptions, cao_of
from rendezview_ground.mesh.mesh import Mesh


def mesh_of(*bodies: trimesh.Trimesh) -> Mesh:
    whole = trimesh.util.concatenate(list(bodies))
    assert isinstance(whole, trimesh.Trimesh)
    faces = np.asarray(whole.faces, dtype=np.int32)
    grey = np.full((len(faces), 3), 0.6, dtype=np.float32)
    return Mesh(np.asarray(whole.vertices, dtype=np.float64), faces, grey, ())


def cube(
    size: float = 2.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    return trimesh.creation.box(
        (size, size, size), trimesh.transformations.translation_matrix(centre)
    )


def area_vector(cao: Cao, face: list[int]) -> np.ndarray:
    corners = cao.points_m[face]
    return 0.5 * np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)


def borders(faces: list[list[int]]) -> Counter[tuple[int, int]]:
    return Counter((a, b) for f in faces for a, b in zip(f, [*f[1:], f[0]], strict=True))


def test_a_cube_has_eight_points_and_six_faces() -> None:
    cao = cao_of(mesh_of(cube()))
    assert len(cao.points_m) == 8
    assert [len(face) for face in cao.faces] == [4] * 6
    assert not cao.smooth
    assert not cao.lines


def test_faces_of_a_cube_look_outwards() -> None:
    cao = cao_of(mesh_of(cube(centre=(5.0, -3.0, 1.0))))
    for face in cao.faces:
        outwards = cao.points_m[face].mean(axis=0) - [5.0, -3.0, 1.0]
        np.testing.assert_allclose(area_vector(cao, face), 4.0 * outwards, atol=1e-9)


@pytest.mark.parametrize("body", [cube(), trimesh.creation.cylinder(1.0, 2.0, sections=48)])
def test_each_border_is_passed_once_in_either_direction(body: trimesh.Trimesh) -> None:
    cao = cao_of(mesh_of(body))
    passed = borders(cao.faces + cao.smooth)
    assert set(passed.values()) == {1}
    assert all((b, a) in passed for a, b in passed)


def test_a_cylinder_is_two_tracked_ends_and_patches_that_only_hide() -> None:
    cao = cao_of(mesh_of(trimesh.creation.cylinder(1.0, 2.0, sections=96)))
    assert len(cao.faces) == 2
    assert 5 <= len(cao.smooth) <= 12
    # the round border keeps to the mesh within the allowed share of the diameter
    for face in cao.faces:
        lost = 1.0 - np.linalg.norm(area_vector(cao, face)) / np.pi
        assert 0.0 < lost < 0.03
        assert len(face) < 48


def test_the_borders_of_patches_can_be_tracked_too() -> None:
    body = trimesh.creation.cylinder(1.0, 2.0, sections=96)
    cao = cao_of(mesh_of(body), CaoOptions(smooth_borders=True))
    assert len(cao.faces) >= 7
    assert not cao.smooth


def test_a_face_with_a_hole_is_one_border_with_its_area() -> None:
    ring = trimesh.creation.annulus(1.0, 2.0, 3.0, sections=64)
    cao = cao_of(mesh_of(ring), CaoOptions(straight=1e-6))
    ends = [f for f in cao.smooth if np.ptp(cao.points_m[f][:, 2]) < 1e-9]
    wanted = 32.0 * np.sin(2.0 * np.pi / 64) * (4.0 - 1.0)  # of polygons with 64 corners
    areas = [np.linalg.norm(area_vector(cao, end)) for end in ends]
    assert areas == pytest.approx([wanted, wanted])
    # both rims of both ends are lines; the bridges to the holes and the curved borders are not
    assert len(cao.lines) == 4 * 64
    heights = cao.points_m[np.array(cao.lines)][:, :, 2]
    assert np.all(np.ptp(heights, axis=1) < 1e-9)


def test_small_and_thin_bodies_are_left_out() -> None:
    small = cube(0.05, (3.0, 0.0, 0.0))
    thin = trimesh.creation.cylinder(
        0.01, 2.0, transform=trimesh.transformations.translation_matrix((0.0, 3.0, 0.0))
    )
    cao = cao_of(mesh_of(cube(), small, thin))
    assert len(cao.points_m) == 8
    assert len(cao.faces) == 6


def test_narrow_faces_are_not_tracked_but_the_wide_ones_beside_them_are() -> None:
    plate = trimesh.creation.box((4.0, 4.0, 0.01))
    cao = cao_of(mesh_of(plate))
    assert len(cao.faces) == 2
    assert not cao.smooth


def test_the_text_counts_what_it_lists() -> None:
    cao = cao_of(mesh_of(trimesh.creation.cylinder(1.0, 2.0, sections=48)))
    rows = cao.text.splitlines()
    assert rows.pop(0) == "V1"
    points = [rows.pop(0).split() for _ in range(int(rows.pop(0)))]
    np.testing.assert_allclose(np.array(points, dtype=float), cao.points_m, rtol=1e-8, atol=1e-8)
    lines = [rows.pop(0).split() for _ in range(int(rows.pop(0)))]
    assert len(lines) == len(cao.lines)
    assert rows.pop(0) == "0"
    faces = [rows.pop(0).split() for _ in range(int(rows.pop(0)))]
    assert rows == ["0", "0"]
    named = [words for words in faces if words[-1] == "name=smooth"]
    assert len(named) == len(cao.smooth)
    for words in faces:
        numbers = [int(w) for w in words if not w.startswith("name")]
        assert numbers[0] == len(numbers) - 1
        assert all(0 <= k < len(cao.points_m) for k in numbers[1:])
