"""Points of the surface: where they lie and from where they are seen."""

from __future__ import annotations

import numpy as np
import trimesh
from tests.ground.mesh.mesh_samples import grey_mesh

from rendezview.geometry.geodesic import Geodesic
from rendezview.sensors.appearance.model.contours import POINT_UNIT
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.surface_points import (
    candidate_points,
    chosen_surface,
    visible_points,
)
from rendezview_ground.mesh.mesh import Mesh

OPTIONS = TrainingOptions(surface_points=400, contour_resolution_px=200)


def surface_of(mesh: Mesh, order: int = 2):
    geometry = view_geometry(mesh, OPTIONS, None)
    points, faces = candidate_points(mesh, geometry, OPTIONS)
    nodes = Geodesic.of_order(order).nodes
    seen = np.stack([visible_points(mesh, geometry, points, faces, d, OPTIONS)[0] for d in nodes])
    surface = chosen_surface(mesh, geometry, points, faces, seen, OPTIONS)
    metres = surface.point * (POINT_UNIT * geometry.target_radius_m) + geometry.centre_m
    bits = np.unpackbits(surface.seen, axis=1, count=len(metres), bitorder="little").astype(bool)
    return surface, metres, bits, nodes


def test_points_of_a_box_lie_on_its_faces_as_many_to_each_square_metre():
    surface, metres, _, _ = surface_of(grey_mesh([trimesh.creation.box((2.0, 1.0, 0.5))]))
    on_face = np.isclose(np.abs(metres), [1.0, 0.5, 0.25], atol=2e-4)
    assert np.all(on_face.any(axis=1))
    share = on_face.mean(axis=0)
    assert np.allclose(share, np.array([0.5, 1.0, 2.0]) / 3.5, atol=0.08)
    normals = surface.normal / 127.0
    across = np.argmax(np.abs(normals), axis=1)
    assert np.allclose(np.abs(normals)[np.arange(len(metres)), across], 1.0, atol=1e-3)
    assert np.all(on_face[np.arange(len(metres)), across])
    assert np.allclose(surface.albedo * ALBEDO_UNIT, 0.6, atol=3e-3)


def test_of_a_box_just_the_faces_that_look_at_the_camera_are_seen():
    _, metres, bits, nodes = surface_of(grey_mesh([trimesh.creation.box((2.0, 1.0, 0.5))]))
    face = np.argmax(np.abs(metres) / [1.0, 0.5, 0.25], axis=1)
    outward = np.zeros_like(metres)
    outward[np.arange(len(metres)), face] = np.sign(metres[np.arange(len(metres)), face])
    cosine = nodes @ outward.T
    assert bits[cosine > 0.2].mean() > 0.97
    assert bits[cosine < -0.1].mean() < 0.01


def test_what_stands_in_the_shadow_of_another_part_is_not_seen():
    plate = trimesh.creation.box((2.0, 2.0, 0.1))
    roof = trimesh.creation.box((2.0, 2.0, 0.1))
    roof.apply_translation([0.0, 0.0, 1.0])
    _, metres, bits, nodes = surface_of(grey_mesh([plate, roof]))
    inside = (np.abs(metres[:, 2] - 0.05) < 1e-3) & (np.abs(metres[:, :2]).max(axis=1) < 0.4)
    above = nodes[:, 2] > 0.95
    aside = (nodes[:, 2] > 0.1) & (nodes[:, 2] < 0.4)
    assert inside.any()
    assert not bits[above][:, inside].any()
    assert bits[aside][:, inside].mean() > 0.5


def test_a_part_inside_another_has_no_points():
    shell, core = trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((1.0, 1.0, 1.0))
    _, metres, _, _ = surface_of(grey_mesh([shell, core]))
    assert len(metres) == 400
    assert np.abs(metres).max(axis=1).min() > 0.9
