"""Random craft: whole meshes of both kinds."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rendezview_ground.mesh.symmetries import find_symmetries
from rendezview_ground.simulate.near_symmetric_craft import any_near_symmetric
from rendezview_ground.simulate.random_craft import any_craft, compact_craft, random_craft


@pytest.mark.parametrize("kind", [random_craft, compact_craft])
def test_craft_are_whole_meshes_and_differ(kind) -> None:
    sizes = set()
    for seed in range(20):
        mesh = kind(np.random.default_rng(seed))
        assert np.isfinite(mesh.vertices_m).all()
        assert mesh.faces.max() < len(mesh.vertices_m)
        assert len(mesh.face_rgb) == len(mesh.faces)
        assert mesh.face_rgb.min() >= 0.0
        assert mesh.face_rgb.max() <= 1.0
        assert 0.3 < mesh.bounding_sphere[1] < 8.0
        sizes.add(len(mesh.faces))
    assert len(sizes) > 15


def test_both_kinds_are_drawn_and_the_same_seed_gives_the_same_craft() -> None:
    extents = [any_craft(np.random.default_rng([7, k])).extent_m.max() for k in range(12)]
    assert extents == [any_craft(np.random.default_rng([7, k])).extent_m.max() for k in range(12)]
    kinds = {np.random.default_rng([7, k]).random() < 0.4 for k in range(12)}
    assert kinds == {True, False}


def test_near_symmetric_craft_nearly_map_onto_themselves_and_no_more() -> None:
    for seed in range(8):
        mesh = any_near_symmetric(np.random.default_rng(seed))
        whole = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
        points = trimesh.sample.sample_surface(whole, 12000, seed=seed)[0]
        surface, shares = cKDTree(points), []
        for sides in (2, 3, 4, 6, 8, 12):
            turn = Rotation.from_euler("z", 360.0 / sides, degrees=True)
            distance = surface.query(turn.apply(points))[0]
            shares.append(float(np.mean(distance < 0.09)))
        assert max(shares) > 0.9
        assert not find_symmetries(mesh)
