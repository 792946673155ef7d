"""Contour points and shadowed silhouettes of views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from tests.ground.mesh.mesh_samples import grey_mesh

from rendezview.sensors.appearance.model.contours import (
    DEPTH_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    RUN_UNIT,
    START_UNIT,
)
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.contours import contour_points
from rendezview_ground.learn.views.shadowed_silhouettes import shadowed_silhouettes, sun_maps
from rendezview_ground.learn.views.surface_palette import packed_surfaces, surface_palette
from rendezview_ground.learn.views.views import look_from
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import faces_beside

OPTIONS = TrainingOptions(contour_points=200, contour_resolution_px=256)


def points_of(mesh: Mesh, direction, range_radii=3.0):
    geometry = view_geometry(mesh, OPTIONS, None)
    direction = np.asarray(direction) / np.linalg.norm(direction)
    view = contour_points(
        mesh,
        faces_beside(mesh),
        geometry,
        direction,
        range_radii * geometry.target_radius_m,
        OPTIONS,
    )
    kept = view["kind"] != NO_POINT
    metres = view["point"][kept] * POINT_UNIT * geometry.target_radius_m + geometry.centre_m
    return metres, {name: values[kept] for name, values in view.items()}, geometry


def test_points_of_a_box_lie_on_its_edges():
    mesh = grey_mesh([trimesh.creation.box((2.0, 1.0, 0.5))])
    points, view, _ = points_of(mesh, [1.0, 0.7, 0.5])
    on_face = np.isclose(np.abs(points), [1.0, 0.5, 0.25], atol=2e-4)
    assert len(points) > 150
    assert np.all(on_face.sum(axis=1) >= 2)  # an edge lies in two faces
    along = view["tangent"] / 127.0
    assert np.all(np.max(np.abs(along), axis=1) > 0.99)  # of a box, along an axis


def test_points_of_a_ball_lie_on_its_rim_seen_from_the_camera():
    mesh = grey_mesh([trimesh.creation.icosphere(subdivisions=4)])
    direction = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    points, view, _ = points_of(mesh, direction)
    rim = points[view["kind"] == OUTLINE]
    assert np.linalg.norm(rim, axis=1) == pytest.approx(1.0, abs=0.01)
    assert rim @ direction == pytest.approx(1.0 / 3.0, abs=0.1)  # tangent cone from 3 radii


def test_the_outside_lies_to_the_right_of_the_tangent():
    mesh = grey_mesh([trimesh.creation.icosphere(subdivisions=3)])
    direction = np.array([0.0, -1.0, 0.0])
    points, view, _ = points_of(mesh, direction)
    rotation = look_from(direction)
    along = (view["tangent"] / 127.0) @ rotation.T
    place = points @ rotation.T
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)  # right of it on the screen, y down
    assert np.all(np.sum(outward * place[:, :2], axis=1)[view["kind"] == OUTLINE] > 0.0)


def test_a_thin_bar_has_short_runs_and_few_points():
    bar = trimesh.creation.box((2.0, 0.008, 0.008))
    bar.apply_translation((0.0, 0.9, 0.0))
    mesh = grey_mesh([trimesh.creation.box((1.6, 1.0, 0.3)), bar])
    points, view, geometry = points_of(mesh, [0.0, 0.0, 1.0])
    thin = points[:, 1] > 0.8
    assert np.mean(thin) < 0.1
    runs_m = view["run"][:, 0] * RUN_UNIT * geometry.target_radius_m
    assert np.all(runs_m[thin] < 0.03)
    assert np.median(runs_m[~thin]) > 0.1


def test_profiles_have_the_surface_inside_the_edge_and_the_sky_beyond_a_thin_body():
    bodies = [trimesh.creation.box((1.6, 1.0, 0.3)), trimesh.creation.box((2.6, 0.04, 0.3))]
    mesh = grey_mesh(bodies)
    points, view, _ = points_of(mesh, [0.0, 0.0, 1.0])
    surfaces = view["surfaces"].astype(float)
    outline = view["kind"] == OUTLINE
    plain = outline & (np.abs(points[:, 0]) < 0.7)
    assert surfaces[plain, 0, 3] == pytest.approx(0.6 * 255.0, abs=2.0)
    assert surfaces[plain, 0, 2] == pytest.approx(255.0, abs=2.0)  # faces the camera
    spike = outline & (np.abs(points[:, 0]) > 0.9) & (np.abs(points[:, 0]) < 1.25)
    assert spike.sum() > 2
    assert np.all(surfaces[spike, -1, 3] == 0.0)  # the profile has left the thin body


def test_a_rim_ends_where_what_stands_before_it_hides_it():
    """A plate before a wider flange: of the flange a band thinner than a pixel is visible."""
    eye_m, depth_m, wide = 5.0, 0.5, 5e-4  # wide: of what is seen of the flange, a tangent
    half = np.array([1.0, 0.6]) / eye_m + wide
    plate = trimesh.creation.box((2.0, 1.2, 0.1))
    flange = trimesh.creation.box((*(2.0 * half * (eye_m + depth_m)), 0.1))
    plate.apply_translation((0.0, 0.0, -0.05))
    flange.apply_translation((0.0, 0.0, -0.05 - depth_m))
    mesh = grey_mesh([plate, flange])
    centre_m, radius_m = mesh.bounding_sphere
    range_m = eye_m - centre_m[2]
    metres, view, geometry = points_of(mesh, [0.0, 0.0, 1.0], range_m / radius_m)
    outline = (view["kind"] == OUTLINE) & (np.abs(metres[:, 2] + depth_m) < 1e-3)
    assert outline.sum() > 60
    begins = view["start"][outline, 0].astype(float)
    distance = eye_m + depth_m
    widths = begins[:, 0] ** 2 * START_UNIT * geometry.target_radius_m / distance
    assert np.median(widths) == pytest.approx(wide, rel=0.1)
    deep = begins[:, 1] * DEPTH_UNIT * geometry.target_radius_m
    assert np.median(deep) == pytest.approx(-depth_m, abs=0.02)


def test_a_profile_tells_where_paint_changes_along_the_normal():
    """From the left edge of a plate: 25 mm of dark paint, 35 mm of white, then grey."""
    borders, paints = [-1.0, -0.975, -0.94, 1.0], [0.1, 0.8, 0.4]
    bodies, colours = [], []
    for left, right, paint in zip(borders[:-1], borders[1:], paints, strict=True):
        body = trimesh.creation.box((right - left, 1.0, 0.05))
        body.apply_translation((0.5 * (left + right), 0.0, 0.0))
        bodies.append(body)
        colours += [paint] * len(body.faces)
    plate = grey_mesh(bodies)
    mesh = replace(plate, face_rgb=np.repeat(np.float32(colours)[:, None], 3, axis=1))
    metres, view, geometry = points_of(mesh, [0.0, 0.0, 1.0])
    at_left = np.isclose(metres[:, 0], -1.0, atol=1e-3) & (np.abs(metres[:, 1]) < 0.4)
    at_left &= (view["kind"] == OUTLINE) & np.isclose(metres[:, 2], 0.025, atol=1e-3)
    assert at_left.sum() >= 5
    begins = view["start"][at_left].astype(float)
    inside_m = begins[..., 0] ** 2 * START_UNIT * geometry.target_radius_m
    # Across the ray to the edge, which is not quite the plate's own plane.
    above_m = 3.0 * geometry.target_radius_m - 0.025
    for k, width_m in enumerate([0.025, 0.060]):
        turn = np.arctan2(1.0, above_m) - np.arctan2(1.0 - width_m, above_m)
        expected = np.hypot(1.0, above_m) * np.tan(turn)
        assert np.median(inside_m[:, k]) == pytest.approx(expected, abs=5e-4)
    albedo = view["surfaces"][at_left, :3, 3] / 255.0
    assert np.median(albedo, axis=0) == pytest.approx(paints, abs=0.02)


def test_a_palette_has_every_surface_that_there_are_few_of():
    rng = np.random.default_rng(0)
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    which = rng.integers(0, 3, 500)
    albedo = np.where(rng.random(500) < 0.3, 0.2, 0.8)
    albedo[:50] = 0.0
    palette, kind = surface_palette(packed_surfaces(normals[which], albedo))
    assert np.all((kind == 0) == (albedo == 0.0))
    seen = kind > 0
    assert palette[kind[seen], 3] == pytest.approx(albedo[seen], abs=0.005)
    along = np.abs(np.einsum("ij,ij->i", palette[kind[seen], :3], normals[which][seen]))
    assert along == pytest.approx(1.0, abs=1e-3)


def test_faces_beside_share_an_edge():
    mesh = grey_mesh([trimesh.creation.box((1.0, 1.0, 1.0))])
    beside = faces_beside(mesh)
    assert beside.min() >= 0
    for face, others in enumerate(beside):
        for k, other in enumerate(others):
            edge = {mesh.faces[face][k], mesh.faces[face][(k + 1) % 3]}
            assert edge <= set(mesh.faces[other])


def test_a_face_in_shadow_or_turned_away_is_not_lit(bumpy_mesh):
    geometry = view_geometry(bumpy_mesh, OPTIONS, None)
    maps = sun_maps(bumpy_mesh, geometry)
    direction = np.array([0.2, 0.3, 0.93]) / np.linalg.norm([0.2, 0.3, 0.93])
    lit = shadowed_silhouettes(bumpy_mesh, maps, geometry, 7, direction)
    assert len(lit["sun"]) > 5
    assert set(lit["view"]) == {7}
    phases = np.arccos(maps.suns[lit["sun"]] @ direction)
    low, high = lit["area_m2"][phases < np.deg2rad(45)], lit["area_m2"][phases > np.deg2rad(65)]
    assert low.mean() > 1.1 * high.mean()  # the farther round the Sun, the less is lit
    assert np.linalg.norm(lit["quat_wxyz"], axis=1) == pytest.approx(1.0, abs=1e-6)
