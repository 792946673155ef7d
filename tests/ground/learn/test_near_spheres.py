"""Spheres of views around a docking ring."""

from __future__ import annotations

import numpy as np
import pytest
from tests.ground.mesh.docking_face import RING, docking_mesh

from rendezview.geometry.camera import Camera
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance.model.contours import NO_POINT, POINT_UNIT
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.contours import contour_points
from rendezview_ground.learn.views.near_spheres import near_spheres
from rendezview_ground.render.crossings import faces_beside

OPTIONS = TrainingOptions(contour_resolution_px=256)


@pytest.fixture(scope="module")
def mesh():
    return docking_mesh()


def test_each_sphere_is_a_third_of_the_last_and_encloses_the_ring(mesh):
    whole = view_geometry(mesh, OPTIONS, None)
    spheres = near_spheres(whole, OPTIONS, RING, None)
    radii = [sphere.geometry.target_radius_m for sphere in spheres]
    assert radii == pytest.approx([2 / 3 * whole.target_radius_m, 2 / 9 * whole.target_radius_m])
    assert min(radii) > 2.0 * RING.radius_m
    for sphere in spheres:
        assert sphere.geometry.centre_m == pytest.approx(RING.centre_m)
        assert np.all(sphere.directions @ RING.axis > np.cos(OPTIONS.near_cone_rad))
    assert spheres[1].shells_m[-1] > spheres[0].shells_m[0]  # no gap between them
    large = DockingRing(RING.centre_m, RING.axis, 0.4 * whole.target_radius_m)
    assert near_spheres(whole, OPTIONS, large, None) == []


def test_a_camera_of_a_narrow_field_gets_narrow_views(mesh):
    narrow = Camera(400, 300, 1000.0, 1000.0, 199.5, 149.5)
    whole = view_geometry(mesh, OPTIONS, narrow)
    sphere = near_spheres(whole, OPTIONS, RING, narrow)[0]
    corner = np.arctan(np.hypot(199.5, 149.5) / 1000.0)
    assert sphere.geometry.near_half_rad == pytest.approx(corner, rel=1e-6)


@pytest.mark.parametrize("which", [0, 1])
def test_points_lie_on_edges_of_the_part_that_the_sphere_encloses(mesh, which):
    """Also where wings reach behind the camera."""
    whole = view_geometry(mesh, OPTIONS, None)
    sphere = near_spheres(whole, OPTIONS, RING, None)[which]
    radius_m = sphere.geometry.target_radius_m
    beside = faces_beside(mesh)
    for direction in sphere.directions[::15]:
        for range_m in sphere.shells_m[[0, 3]]:
            view = contour_points(mesh, beside, sphere.geometry, direction, range_m, OPTIONS)
            kept = view["kind"] != NO_POINT
            assert kept.sum() >= 60
            points = view["point"][kept] * POINT_UNIT * radius_m
            assert np.linalg.norm(points, axis=1).max() < 1.02 * radius_m
            # Near an edge of the mesh: of each point the nearest edge, over all edges.
            assert np.max(_to_edges(points + RING.centre_m, mesh)) < 2e-3


def _to_edges(points: np.ndarray, mesh) -> np.ndarray:
    """Distances (N,) to the nearest edge of any face, m."""
    corners = mesh.vertices_m[mesh.faces]
    starts, ends = corners.reshape(-1, 3), np.roll(corners, -1, axis=1).reshape(-1, 3)
    along = ends - starts
    share = np.einsum("nek,ek->ne", points[:, None] - starts, along)
    share = np.clip(share / np.sum(along**2, axis=1), 0.0, 1.0)
    feet = starts + share[..., None] * along
    return np.linalg.norm(points[:, None] - feet, axis=2).min(axis=1)
