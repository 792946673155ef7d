"""Views drawn from the shown faces only look like views of the whole mesh."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Pose
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.learn.views.views import look_from
from rendezview_ground.render.projection import Window
from rendezview_ground.render.rasterizer import NumbaRenderer
from rendezview_ground.render.shown_faces import SOME_AROUND, ShownFaces, ShownRenderer, bits_of

OPTIONS = TrainingOptions(contour_resolution_px=240)


@pytest.fixture(scope="module")
def shown(bumpy_mesh):
    geometry = view_geometry(bumpy_mesh, OPTIONS, None)
    nodes = Geodesic.of_order(3).nodes
    bits = []
    for node in nodes:
        views = [
            draw_view(bumpy_mesh, geometry, node, radii * geometry.target_radius_m, 240, 4.0)
            for radii in (3.0, 100.0)
        ]
        bits.append(bits_of(np.stack([v.owner for v in views]), len(bumpy_mesh.faces)))
    return ShownFaces(nodes, np.array(bits), len(bumpy_mesh.faces)), geometry


def looking(direction, radii, geometry):
    rotation = look_from(direction)
    range_m = radii * geometry.target_radius_m
    pose = Pose(rotation, np.array([0.0, 0.0, range_m]) - rotation @ geometry.centre_m)
    focal = 90.0 / np.tan(np.arcsin(1.0 / radii))
    return pose, Window(200, 200, float(focal), 99.5, 99.5)


def test_a_silhouette_of_the_shown_faces_is_that_of_the_mesh(bumpy_mesh, shown):
    lists, geometry = shown
    some = ShownRenderer(bumpy_mesh, lists, geometry.centre_m)
    some = pickle.loads(pickle.dumps(some))  # workers get a copy
    rng = np.random.default_rng(1)
    wrong = fewer = 0
    for direction in rng.normal(size=(20, 3)):
        direction /= np.linalg.norm(direction)
        pose, window = looking(direction, rng.uniform(3.0, 9.0), geometry)
        mask, whole = some.draw(pose, window), NumbaRenderer(bumpy_mesh).draw(pose, window)
        wrong += np.count_nonzero(mask != whole) / np.count_nonzero(whole)
        fewer += len(lists.near(direction, SOME_AROUND)) < 0.85 * len(bumpy_mesh.faces)
    assert wrong / 20 < 1e-3
    assert fewer == 20


def test_a_z_buffer_of_the_shown_faces_is_that_of_the_mesh(bumpy_mesh, shown):
    lists, geometry = shown
    some = ShownRenderer(bumpy_mesh, lists, geometry.centre_m)
    for direction in np.eye(3):
        range_m = 4.0 * geometry.target_radius_m
        whole = draw_view(bumpy_mesh, geometry, direction, range_m, 160, 4.0)
        view = draw_view(bumpy_mesh, geometry, direction, range_m, 160, 4.0, some)
        assert np.mean(view.owner != whole.owner) < 1e-3
        same = view.owner == whole.owner
        assert np.allclose(view.nearness[same], whole.nearness[same], rtol=1e-5)


def test_bits_are_the_faces_that_own_a_pixel():
    owner = np.array([[-1, 3], [9, 3]], dtype=np.int32)
    bits = np.unpackbits(bits_of(owner, 11), bitorder="little", count=11)
    assert np.flatnonzero(bits).tolist() == [3, 9]
