"""Fields of brightness beside the matt model."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh
from tests.ground.mesh.mesh_samples import grey_mesh

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.judge.drawn import DrawnEvidence
from rendezview.sensors.appearance.judge.gloss import add_gloss
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.carried_shape import carried_shape

SIDE = 40


def test_each_direction_gets_its_weighted_plane_of_brightness() -> None:
    """Against numpy's least squares with the same prior, its weights from the fit before."""
    rng = np.random.default_rng(3)
    where = np.sort(rng.choice(SIDE * SIDE, 700, replace=False))
    facets = rng.integers(0, 4, 700)
    sunlit = np.where(rng.random(700) < 0.2, 0.0, 0.5)
    matt = rng.uniform(60.0, 80.0, 700)
    seen = matt + rng.normal(0.0, 5.0, 700) + facets * (where % SIDE) / 10.0
    seen[::25] = 0.0  # a shadow that the matt model does not have
    levels = matt.copy()
    at = np.stack([np.ones(700), 2 * (where % SIDE) / SIDE - 1, 2 * (where // SIDE) / SIDE - 1])
    add_gloss(at[1:].T.copy(), facets, sunlit, seen, 8.0, 6.0, levels)

    expected = matt.copy()
    prior = 6.0 * np.diag([1.0, 0.1, 0.1])
    for k in range(4):
        here = (facets == k) & (sunlit > 0.0)
        basis, rest, field = at[:, here].T, (seen - matt)[here], np.zeros(3)
        for step in range(3):
            off = (rest - basis @ field) / 8.0
            weight = (1.0 + off**2) ** -2.0 if step else np.ones(len(rest))
            normal = basis.T @ (weight[:, None] * basis) + prior
            field = np.linalg.solve(normal, basis.T @ (weight * rest))
        expected[here] += basis @ field
    np.testing.assert_allclose(levels, np.maximum(expected, 0.0))


def test_levels_stay_above_black() -> None:
    levels = np.full(50, 10.0)
    add_gloss(
        np.zeros((50, 2)), np.zeros(50, np.intp), np.ones(50), np.full(50, -60.0), 200.0, 1.0,
        levels,
    )  # fmt: skip
    np.testing.assert_array_equal(levels, 0.0)


def test_a_glossy_plate_is_explained_and_its_shadow_is_not(tiny_model: ViewModel) -> None:
    """A plate whose brightness halves from end to end, not in steps."""
    plate = grey_mesh([trimesh.creation.box((4.0, 2.0, 0.1))])
    centre_m, radius_m = plate.bounding_sphere
    shape = carried_shape(plate, view_geometry(plate, TrainingOptions(), None), seed=0)
    model = dataclasses.replace(
        tiny_model, centre_m=centre_m, target_radius_m=radius_m, shape=shape
    )
    camera, pose = Camera.from_fov(320, 320, np.deg2rad(40.0)), Pose(np.eye(3), [0.0, 0.0, 8.0])
    column, row = np.meshgrid(np.arange(320.0), np.arange(320.0))
    on = (np.abs(column - 159.5) < 2.0 / 7.95 * camera.fx) & (
        np.abs(row - 159.5) < 1.0 / 7.95 * camera.fy
    )
    frame = np.where(on, 150.0 - 0.4 * (column - 159.5), 5.0)
    shaded = np.where(on & (column > 200) & (row > 160), 5.0, frame)
    noise = np.random.default_rng(1).normal(0.0, 2.0, frame.shape)

    def unexplained(frame: np.ndarray) -> float:
        grey = np.clip(np.rint(frame + noise), 0, 255).astype(np.uint8)
        evidence = DrawnEvidence(model.shape, model, camera)
        window = evidence.window(grey, Sky.of(grey), pose)
        drawn = evidence.drawn(window, pose)
        assert drawn is not None
        drawn = dataclasses.replace(drawn, window=window.beside([drawn]))
        return drawn.under(np.array([0.0, 0.0, -1.0])).cost

    glossy, shadowed = unexplained(frame), unexplained(shaded)
    assert glossy < 40.0  # a matt plate leaves 316 cells open
    assert shadowed > glossy + 80.0  # of the 100 cells in shadow
