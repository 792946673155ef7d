"""Random everyday objects, and the textures that are stuck on them."""

from __future__ import annotations

import numpy as np

from experiments.training.random_objects import random_object
from experiments.training.random_textures import random_texture, scatter_shapes


def test_objects_are_grey_meshes_of_many_kinds_and_the_same_for_a_seed() -> None:
    counts = set()
    for k in range(40):
        mesh = random_object(np.random.default_rng(k))
        assert np.isfinite(mesh.vertices_m).all()
        assert 0.1 < mesh.bounding_sphere[1] < 12.0
        assert mesh.faces.max() < len(mesh.vertices_m)
        assert (mesh.face_rgb >= 0.0).all()
        assert (mesh.face_rgb <= 1.0).all()
        np.testing.assert_array_equal(mesh.face_rgb[:, 0], mesh.face_rgb[:, 2])
        counts.add(len(mesh.faces))
    assert len(counts) > 10
    first, again = (random_object(np.random.default_rng(0)) for _ in range(2))
    np.testing.assert_array_equal(first.vertices_m, again.vertices_m)


def test_textures_are_reflectances_and_most_have_contrast() -> None:
    contrast = []
    for k in range(40):
        texture = random_texture(128, np.random.default_rng(k))
        assert texture.shape == (128, 128)
        assert texture.dtype == np.float32
        assert texture.min() >= 0.02
        assert texture.max() <= 1.0
        contrast.append(texture.std())
    assert np.median(contrast) > 0.05


def test_shapes_are_drawn_in_place_within_the_levels() -> None:
    picture = np.zeros((96, 96), np.float32)
    scatter_shapes(picture, 30, np.random.default_rng(1))
    assert np.mean(picture > 0.0) > 0.05
    assert picture.max() <= 1.0
