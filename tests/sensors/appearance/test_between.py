"""Between the nodes: directions and ranges from the signatures stored around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.outline.interpolation import Interpolator
from rendezview.sensors.appearance.outline.votes import Match
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.views import ViewSet, clean_views, look_from
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.renderers import make_renderer

RADII = 2.5


@pytest.fixture(scope="module")
def directions() -> Array:
    random = np.random.default_rng(4).standard_normal((24, 3))
    return np.asarray(random / np.linalg.norm(random, axis=1)[:, None])


@pytest.fixture(scope="module")
def exact(bumpy_mesh: Mesh, tiny_options: TrainingOptions, directions: Array) -> ViewSet:
    """Exact outlines from 2.5 sphere radii, between near and far views."""
    geometry = view_geometry(bumpy_mesh, tiny_options, None)
    options = replace(tiny_options, resolution_px=512)
    fine = replace(geometry, resolution_px=512)
    return clean_views(
        make_renderer(options.renderer, bumpy_mesh), fine, options, directions, RADII
    )


def places(model: ViewModel, views: ViewSet) -> tuple[Array, Array]:
    """Errors of direction of the nearest node alone, and between the nodes; range ratios."""
    between, errors, ranges = Interpolator(model), [], []
    for k, direction in enumerate(views.direction):
        node = model.geodesic.nearest(direction)
        only = model.geodesic.nodes[node]
        match = Match(np.array([node]), np.ones(1), only, views.centred_from_target[k])
        signature = Signature(views.readings[k], float(views.area_sr[k]), np.eye(3))
        points, weights = between.points(match, signature, 0.0)
        place = weights @ (points - model.centre_m) / weights.sum()
        far = np.linalg.norm(place)
        errors.append([np.linalg.norm(only - direction), np.linalg.norm(place / far - direction)])
        ranges.append(far / views.range_m[k])
    return np.array(errors), np.array(ranges)


def test_direction_between_nodes_is_several_times_nearer_than_the_node(
    tiny_model: ViewModel, exact: ViewSet
) -> None:
    errors, ranges = places(tiny_model, exact)
    node, between = np.median(errors, axis=0)
    assert between < 0.4 * node
    assert np.median(np.abs(ranges - 1.0)) < 0.015


def test_far_readings_take_perspective_into_account(tiny_model: ViewModel, exact: ViewSet) -> None:
    views = tiny_model.views
    blind = replace(tiny_model, views=views.with_far(views.readings))
    told, untold = (np.median(places(m, exact)[0][:, 1]) for m in (tiny_model, blind))
    assert told < 0.9 * untold


def test_a_fat_outline_is_farther_than_it_looks(tiny_model: ViewModel, exact: ViewSet) -> None:
    signature = Signature(exact.readings[0], float(exact.area_sr[0]), np.eye(3))
    node = tiny_model.geodesic.nearest(exact.direction[0])
    only = tiny_model.geodesic.nodes[node]
    match = Match(np.array([node]), np.ones(1), only, exact.centred_from_target[0])
    between = Interpolator(tiny_model)
    thin, fat = (between.points(match, signature, px)[0] for px in (0.0, 1e-3))
    far = [np.linalg.norm(p - tiny_model.centre_m, axis=1).mean() for p in (thin, fat)]
    assert 1.0005 < far[1] / far[0] < 1.05


def test_model_without_far_readings_gives_the_points_of_its_nodes(
    tiny_model: ViewModel, tmp_path: Path, bumpy_mesh: Mesh, camera: Camera, draw
) -> None:  # type: ignore[no-untyped-def]
    old = replace(tiny_model, views=replace(tiny_model.views, far_change=None))
    old.save(tmp_path / "old.rvm")
    loaded = ViewModel.load(tmp_path / "old.rvm")
    with pytest.raises(ValueError, match="no far readings"):
        Interpolator(loaded)
    rotation = look_from(np.array([0.6, 0.64, 0.48]))
    away = np.array([0.0, 0.0, 1.5 * tiny_model.sphere_radius_m])
    pose = Pose(rotation, away - rotation @ tiny_model.centre_m)
    frame = draw(bumpy_mesh, pose, camera)
    nodes = Recognizer(loaded, camera).recognize(frame, pose)
    points, weights = nodes.cloud
    np.testing.assert_array_equal(points, nodes.points_m)
    assert len(points) == len(weights) > 0
    told = Recognizer(tiny_model, camera).recognize(frame, pose)
    true_place = pose.inverse().translation_m
    points, weights = told.cloud
    off = np.linalg.norm(weights @ points / weights.sum() - true_place)
    assert off < 0.06 * np.linalg.norm(away)
