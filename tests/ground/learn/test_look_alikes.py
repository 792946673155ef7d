"""The turns that nearly map a craft onto itself, and what is said of them."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from tests.ground.mesh.mesh_samples import grey_mesh
from tests.sensors.appearance.judge.near_symmetric import twelve_sides

from rendezview_ground.learn.look_alike_words import look_alike_words
from rendezview_ground.learn.look_alikes import NearSymmetry, look_alikes, rotation_grid
from rendezview_ground.mesh.mesh import Mesh

NOWHERE = np.zeros(3)


def nearest_rad(found: list[NearSymmetry], turn: np.ndarray) -> float:
    """Of all turns that are found, the angle of the nearest to one."""
    between = [turn @ one.turn.T for one in found]
    return min(
        float(np.arccos(np.clip(0.5 * (np.trace(b) - 1.0), -1.0, 1.0)))
        for b in between
        if np.linalg.det(b) > 0.0
    )


def about_z(angle_deg: float) -> np.ndarray:
    return Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def of_drum() -> list[NearSymmetry]:
    return look_alikes(twelve_sides(), NOWHERE)


def test_all_turns_of_twelve_sides_are_found_and_all_mirrors(of_drum: list[NearSymmetry]) -> None:
    mirror = np.diag([1.0, -1.0, 1.0])
    for k in range(12):
        if k > 0:
            assert nearest_rad(of_drum, about_z(30.0 * k)) < np.deg2rad(1.0)
        assert nearest_rad(of_drum, about_z(30.0 * k) @ mirror) < np.deg2rad(1.0)


def test_the_mirror_that_the_boxes_leave_comes_first(of_drum: list[NearSymmetry]) -> None:
    np.testing.assert_allclose(of_drum[0].turn, np.diag([1.0, -1.0, 1.0]), atol=0.01)
    assert of_drum[0].alike > 0.97
    assert of_drum[0].alike > of_drum[1].alike + 0.05
    shares = [one.alike for one in of_drum]
    assert shares == sorted(shares, reverse=True)


def test_turns_are_about_the_view_centre_wherever_the_body_is() -> None:
    box = trimesh.creation.box((3.0, 2.0, 1.0))
    box.apply_translation((1.5, 1.0, 0.5))  # its origin is a corner
    centre = np.array([1.4, 0.9, 0.6])
    found = look_alikes(grey_mesh([box]), centre)
    for axis in np.eye(3):
        turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        one = min(found, key=lambda f: float(np.abs(f.turn - turn).max()))
        np.testing.assert_allclose(one.turn, turn, atol=5e-3)
        assert one.alike > 0.97
        # The middle of the box stays: from the view centre it lies at (0.1, 0.1, −0.1).
        middle = np.array([0.1, 0.1, -0.1])
        np.testing.assert_allclose(one.turn @ middle + one.shift_m, middle, atol=0.01)


def test_a_body_without_symmetry_has_none_that_maps_nearly_all_of_it(bumpy_mesh: Mesh) -> None:
    assert max(one.alike for one in look_alikes(bumpy_mesh, NOWHERE)) < 0.95


def test_the_grid_of_rotations_leaves_no_gap() -> None:
    grid = rotation_grid(np.deg2rad(12.0))
    np.testing.assert_allclose(np.linalg.det(grid), 1.0)
    anywhere = Rotation.random(200, random_state=np.random.default_rng(1)).as_matrix()
    cosines = 0.5 * (np.einsum("nij,mij->nm", anywhere, grid).max(axis=1) - 1.0)
    assert np.rad2deg(np.arccos(cosines.min())) < 12.0


def words_of(found: list[NearSymmetry]) -> str | None:
    return look_alike_words(
        np.array([one.turn for one in found]), np.array([one.alike for one in found])
    )


def test_look_alikes_are_named_once_each_way(of_drum: list[NearSymmetry]) -> None:
    words = words_of(of_drum)
    assert words is not None
    assert "° about z" in words
    assert "33°" not in words
    assert "% of the surface the same" in words
    turns = re.findall(r"\d+° about [xyz] \(", words)
    assert len(turns) == len(set(turns)) == 3


def test_a_craft_like_no_other_is_not_called_nearly_symmetric() -> None:
    assert words_of([NearSymmetry(about_z(90.0), NOWHERE, 0.7)]) is None
