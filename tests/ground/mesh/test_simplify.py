"""A finely cut mesh is drawn with fewer triangles, of the same shape."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import trimesh

from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.mesh import simplify
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.simplify import simplified


def mesh_of(*bodies: trimesh.Trimesh, albedo: tuple[float, ...] = (0.6,)) -> Mesh:
    """The bodies with one albedo each, the last one for the rest."""
    body: Any = trimesh.util.concatenate(bodies)
    levels = np.concatenate(
        [np.full(len(b.faces), albedo[min(k, len(albedo) - 1)]) for k, b in enumerate(bodies)]
    )
    rgb = np.repeat(levels[:, None], 3, axis=1).astype(np.float32)
    return Mesh(np.array(body.vertices), body.faces.astype(np.int32), rgb, ())


def cut_box(times: int) -> trimesh.Trimesh:
    box = trimesh.creation.box((2.0, 1.0, 0.5))
    for _ in range(times):
        box = box.subdivide()
    return box


@pytest.fixture
def any_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simplify, "MANY_FACES", 0)


def test_a_mesh_of_few_triangles_is_drawn_as_it_is() -> None:
    mesh = mesh_of(cut_box(2))
    assert simplified(mesh, 0.01) is mesh


@pytest.mark.usefixtures("any_mesh")
def test_a_cut_up_box_has_few_triangles_again_and_the_same_corners() -> None:
    box = simplified(mesh_of(cut_box(5)), 1e-4)
    assert len(box.faces) < 100  # of 12,288
    np.testing.assert_allclose(np.abs(box.vertices_m).max(axis=0), (1.0, 0.5, 0.25), atol=1e-9)
    corners = box.vertices_m[box.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert 0.5 * np.linalg.norm(normals, axis=1).sum() == pytest.approx(7.0, rel=1e-6)


@pytest.mark.usefixtures("any_mesh")
@pytest.mark.parametrize("tolerance_m", [1e-3, 5e-3])
def test_no_surface_moves_by_more_than_the_tolerance(tolerance_m: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    drawn = simplified(mesh_of(ball), tolerance_m)
    assert 100 < len(drawn.faces) < 0.8 * len(ball.faces)
    shares = np.random.default_rng(1).dirichlet((1.0, 1.0, 1.0), size=(len(drawn.faces), 20))
    radii = np.linalg.norm(shares @ drawn.vertices_m[drawn.faces], axis=-1)
    assert radii.min() > np.linalg.norm(ball.triangles_center, axis=1).min() - tolerance_m
    assert radii.max() < 1.0 + tolerance_m


@pytest.mark.usefixtures("any_mesh")
def test_views_of_it_are_the_same_to_the_pixel() -> None:
    tank = trimesh.creation.icosphere(subdivisions=5, radius=0.1).apply_translation((0, 0, 0.3))
    mesh = mesh_of(cut_box(5), tank, albedo=(0.8, 0.3))
    options = TrainingOptions()
    geometry = view_geometry(mesh, options, None, None)
    drawn = simplified(mesh, simplify.TOLERANCE_RADII * geometry.target_radius_m)
    assert len(drawn.faces) < 0.65 * len(mesh.faces)
    for direction in np.random.default_rng(4).normal(size=(4, 3)):
        views = [
            draw_view(m, geometry, direction / np.linalg.norm(direction), 8.0, 400, 4.0)
            for m in (mesh, drawn)
        ]
        sky = [view.owner < 0 for view in views]
        assert (sky[0] != sky[1]).sum() <= 2
        colours = [m.face_rgb[v.owner, 0] for m, v in zip((mesh, drawn), views, strict=True)]
        differs = (colours[0] != colours[1]) & ~sky[0] & ~sky[1]
        assert differs.sum() <= 0.001 * differs.size
        seen = ~sky[0] & ~sky[1] & ~differs
        np.testing.assert_allclose(views[0].nearness[seen], views[1].nearness[seen], rtol=1e-3)


@pytest.mark.usefixtures("any_mesh")
def test_parts_and_trust_stay_with_their_faces() -> None:
    mesh = mesh_of(cut_box(4), cut_box(4).apply_translation((5.0, 0.0, 0.0)))
    right = mesh.vertices_m[mesh.faces].mean(axis=1)[:, 0] > 2.5
    mesh = dataclasses.replace(
        mesh,
        face_part=right.astype(np.uint8),
        face_trust=np.where(right, 0.3, 1.0).astype(np.float32),
    )
    drawn = simplified(mesh, 1e-4)
    is_right = drawn.vertices_m[drawn.faces].mean(axis=1)[:, 0] > 2.5
    assert drawn.face_part is not None
    assert drawn.face_trust is not None
    np.testing.assert_array_equal(drawn.face_part, is_right)
    np.testing.assert_allclose(drawn.face_trust, np.where(is_right, 0.3, 1.0), rtol=1e-6)


@pytest.mark.usefixtures("any_mesh")
def test_the_border_between_two_colours_stays() -> None:
    plate = cut_box(5)
    left = plate.triangles_center[:, 0] < 0.0
    rgb = np.repeat(np.where(left, 0.2, 0.9)[:, None], 3, axis=1).astype(np.float32)
    mesh = Mesh(np.array(plate.vertices), plate.faces.astype(np.int32), rgb, ())
    drawn = simplified(mesh, 1e-4)
    assert len(drawn.faces) < 0.2 * len(mesh.faces)
    x = drawn.vertices_m[drawn.faces][:, :, 0]
    dark = drawn.face_rgb[:, 0] < 0.5
    assert x[dark].max() == pytest.approx(0.0, abs=1e-9)
    assert x[~dark].min() == pytest.approx(0.0, abs=1e-9)
