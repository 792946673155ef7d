"""Training views: where they are seen from, and that they see what geometry says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.geodesic import Geodesic
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.perturbed_views import perturbed_views
from rendezview_ground.learn.views.views import (
    clean_views,
    far_views,
    lattice_slopes,
    look_from,
    plane_rays,
)
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.rasterizer import NumbaRenderer

OPTIONS = TrainingOptions(order=1, bins=90, smooth_bins=1, resolution_px=256, component_step=1)


def ball(radius: float, centre: np.ndarray) -> Mesh:
    sphere = Geodesic.of_order(3)
    rgb = np.full((len(sphere.faces), 3), 0.6, dtype=np.float32)
    return Mesh(sphere.nodes * radius + centre, sphere.faces, rgb, ())


def test_cameras_look_at_the_view_centre_with_the_targets_z_up():
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        rotation = look_from(direction)
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert np.allclose(rotation[2], -direction)
        if abs(direction[2]) < 0.9:
            up = rotation @ [0.0, 0.0, 1.0]
            assert up[0] == pytest.approx(0.0, abs=1e-12)
            assert up[1] < 0.0  # y down
        rolled = look_from(direction, 0.3)
        c, s = np.cos(0.3), np.sin(0.3)
        assert np.allclose(rolled, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation)


def test_a_ball_has_the_area_of_its_cone_at_every_range():
    centre = np.array([3.0, -2.0, 1.0])
    mesh = ball(0.7, centre)
    geometry = view_geometry(mesh, OPTIONS, None)
    assert geometry.centre_m == pytest.approx(centre)
    assert geometry.target_radius_m == pytest.approx(0.7)
    assert geometry.sphere_radius_m == pytest.approx(2.1)
    nodes = Geodesic.of_order(0).nodes
    for draw, range_m in ((clean_views, 2.1), (far_views, 8.4)):
        views = draw(NumbaRenderer(mesh), geometry, OPTIONS, nodes)
        expected = np.pi * (0.7 / range_m) ** 2  # vector area π sin² of the cone
        assert np.allclose(views.area_sr, expected, rtol=0.01)
        assert np.allclose(views.range_m, range_m)
        assert np.abs(views.offset_m).max() < 0.01
        # distances in the tangent plane over an area on the sphere: tan / sin = 1 / cos
        reading = 1000.0 / np.sqrt(np.pi) / np.cos(np.arcsin(0.7 / range_m))
        assert np.abs(views.readings / reading - 1.0).max() < 0.02


def test_slopes_are_the_change_of_area_with_range(bumpy_mesh):
    geometry = view_geometry(bumpy_mesh, OPTIONS, None)
    nodes, renderer = Geodesic.of_order(0).nodes, NumbaRenderer(bumpy_mesh)
    near = clean_views(renderer, geometry, OPTIONS, nodes)
    far = far_views(renderer, geometry, OPTIONS, nodes)
    slopes = lattice_slopes(near, far, geometry)
    middle = clean_views(renderer, geometry, OPTIONS, nodes, 2.0)
    law = near.area_sr * near.range_m**2 * (1.0 + slopes * (0.5 - 1.0))
    assert np.allclose(middle.area_sr * middle.range_m**2, law, rtol=0.02)
    assert np.abs(slopes).max() > 0.02


def test_offsets_point_from_the_centroid_to_the_view_centre(bumpy_mesh):
    geometry = view_geometry(bumpy_mesh, OPTIONS, None)
    views = clean_views(NumbaRenderer(bumpy_mesh), geometry, OPTIONS, Geodesic.of_order(0).nodes)
    for k in range(len(views)):
        centre = -views.range_m[k] * (views.centred_from_target[k] @ views.direction[k])
        assert np.allclose(centre[:2] / centre[2] * views.range_m[k], views.offset_m[k])
    assert np.linalg.norm(views.offset_m, axis=1).max() > 0.1


def test_perturbed_views_do_not_depend_on_how_they_are_shared_out(bumpy_mesh):
    geometry, renderer = view_geometry(bumpy_mesh, OPTIONS, None), NumbaRenderer(bumpy_mesh)
    whole = perturbed_views(renderer, geometry, OPTIONS, 1, range(6))
    part = perturbed_views(renderer, geometry, OPTIONS, 1, range(3, 6))
    other = perturbed_views(renderer, geometry, OPTIONS, 2, range(6))
    for f in dataclasses.fields(whole):
        assert np.array_equal(getattr(whole, f.name)[3:], getattr(part, f.name))
    assert not np.array_equal(whole.direction, other.direction)


def test_views_of_one_drawing_have_their_own_size_and_noise(bumpy_mesh):
    geometry, renderer = view_geometry(bumpy_mesh, OPTIONS, None), NumbaRenderer(bumpy_mesh)
    views = perturbed_views(renderer, geometry, OPTIONS, 1, range(40))
    first, second = views.direction[::2], views.direction[1::2]
    assert np.array_equal(first, second)
    assert len(np.unique(first, axis=0)) == 20
    apart = np.abs(views.readings[::2] - views.readings[1::2]).max(axis=1)
    assert np.all(apart > 0.0)
    assert np.median(apart) < 100.0
    assert np.abs(views.area_sr[::2] / views.area_sr[1::2] - 1.0).max() < 0.1


def test_rays_of_pixels_are_those_of_a_pinhole():
    rays = plane_rays(np.array([[30.0, 20.0], [31.5, 18.0]]), 50.0, 30.0, 21.0)
    assert np.allclose(rays, [[0.0, -0.02, 1.0], [0.03, -0.06, 1.0]])


def test_perturbed_views_keep_to_their_ranges_and_see_about_the_clean_area(bumpy_mesh):
    options = dataclasses.replace(OPTIONS, range_radii=(1.2, 2.5), clean_fraction=0.0)
    geometry, renderer = view_geometry(bumpy_mesh, options, None), NumbaRenderer(bumpy_mesh)
    views = perturbed_views(renderer, geometry, options, 1, range(40))
    radii = views.range_m / geometry.sphere_radius_m
    assert radii.min() >= 1.2
    assert radii.max() <= 2.5
    assert np.ptp(radii) > 0.6
    for k in range(0, 40, 5):
        clean = clean_views(
            renderer, geometry, options, views.direction[k : k + 1], float(radii[k])
        )
        assert views.area_sr[k] == pytest.approx(clean.area_sr[0], rel=0.08)


def test_a_target_seen_edge_on_is_refused_as_flat():
    flat = Mesh(
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        np.array([[0, 1, 2]], dtype=np.int32),
        np.full((1, 3), 0.6, dtype=np.float32),
        (),
    )
    geometry = view_geometry(flat, OPTIONS, None)
    with pytest.raises(RendezviewError, match="flat or too thin"):
        clean_views(NumbaRenderer(flat), geometry, OPTIONS, np.array([[1.0, 0.0, 0.0]]))
    above = clean_views(NumbaRenderer(flat), geometry, OPTIONS, np.array([[0.0, 0.0, 1.0]]))
    assert above.area_sr[0] > 0.0
