"""Smoothly deformed meshes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from tests.ground.mesh.mesh_samples import grey_mesh

from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.mesh_error import deformed


def ball_with_boom() -> Mesh:
    ball = trimesh.creation.icosphere(3, 1.0)
    boom = trimesh.creation.box((3.0, 0.2, 0.2))
    for _ in range(3):
        boom = boom.subdivide()
    boom.apply_translation([2.0, 0.5, 0.0])
    return grey_mesh([ball, boom])


MESH = ball_with_boom()


def surface(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the faces and their areas, as shares."""
    corners = mesh.vertices_m[mesh.faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    return corners.mean(axis=1), areas / areas.sum()


@pytest.mark.parametrize("share", [0.005, 0.02])
def test_the_surface_moves_by_the_asked_share_of_the_radius(share: float) -> None:
    bent = deformed(MESH, share, np.random.default_rng(2))
    (before, areas), (after, _) = surface(MESH), surface(bent)
    rms = np.sqrt(areas @ ((after - before) ** 2).sum(axis=1))
    assert rms / MESH.bounding_sphere[1] == pytest.approx(share, rel=0.05)
    np.testing.assert_array_equal(bent.faces, MESH.faces)


def test_neighbours_move_together_and_far_parts_do_not() -> None:
    move = deformed(MESH, 0.02, np.random.default_rng(2)).vertices_m - MESH.vertices_m
    edges = MESH.faces[:, :2]
    near = np.linalg.norm(move[edges[:, 0]] - move[edges[:, 1]], axis=1)
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, len(move), (2, 2000))
    far = np.linalg.norm(move[pairs[0]] - move[pairs[1]], axis=1)
    assert np.median(near) < 0.25 * np.median(far)


def test_no_rigid_motion_is_left() -> None:
    bent = deformed(MESH, 0.02, np.random.default_rng(5))
    (before, areas), (after, _) = surface(MESH), surface(bent)
    middle, moved = areas @ before, areas @ after
    # Kabsch: the rotation that brings one onto the other is none
    u, _, vt = np.linalg.svd((after - moved).T @ ((before - middle) * areas[:, None]))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    assert np.linalg.norm(cv2.Rodrigues(rotation)[0]) < 1e-3
    np.testing.assert_allclose(moved, middle, atol=1e-3)


def test_the_seed_makes_the_shape_and_no_error_changes_nothing() -> None:
    one, same, other = (deformed(MESH, 0.01, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.vertices_m, same.vertices_m)
    assert np.abs(one.vertices_m - other.vertices_m).max() > 1e-3
    none = deformed(MESH, 0.0, np.random.default_rng(1))
    np.testing.assert_array_equal(none.vertices_m, MESH.vertices_m)


@pytest.mark.parametrize("share", [-0.1, 0.5, np.nan])
def test_impossible_errors_are_refused(share: float) -> None:
    with pytest.raises(ValueError, match="share"):
        deformed(MESH, share, np.random.default_rng(0))
