"""The pictures of rings have their edges where the truth says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring import shape_of_circle
from rendezview_ground.simulate.ring_frames import (
    Plate,
    RingScene,
    RingSceneOptions,
    radiance,
    random_scene,
    render_ring_frame,
    tilted_axis,
)

CAMERA = Camera.from_fov(320, 240, math.radians(40.0))


@pytest.mark.parametrize("tilt", [0.0, 0.7, 1.1])
def test_a_discs_light_has_the_area_and_the_middle_of_its_ellipse(tilt):
    centre = np.array([0.13, -0.08, 4.0])
    axis = tilted_axis(centre, tilt, 1.0)
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    disc = Plate(centre, axis, across, 100.0, radii_m=(0.0, 0.5))
    light = radiance(RingScene(CAMERA, (disc,), (), sky_grey=0.0)).astype(float) / 100.0
    shape = shape_of_circle(CAMERA, centre, axis, 0.5)
    area = math.pi * (shape[2] * shape[4] - shape[3] ** 2)
    assert light.sum() == pytest.approx(area, rel=2e-4)
    rows, columns = np.mgrid[:240, :320]
    middle = [(light * columns).sum() / light.sum(), (light * rows).sum() / light.sum()]
    np.testing.assert_allclose(middle, shape[:2], atol=0.005)


def test_an_obstacle_leaves_the_arc_it_is_told_to_leave():
    third = math.radians(120.0)
    for seed in range(5):
        options = RingSceneOptions(
            arc_rad=(third, third), width_px=(80.0, 150.0), body=False, tilt_rad=(0.0, 0.3)
        )
        scene = random_scene(CAMERA, np.random.default_rng(seed), options)
        ring = scene.ring
        basis = np.column_stack(
            [scene.plates[0].across, np.cross(ring.axis, scene.plates[0].across)]
        )
        angles = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        without = radiance(RingScene(CAMERA, scene.plates[:-1], scene.circles, scene.sky_grey))
        image = radiance(scene)
        at = CAMERA.project(ring.centre_m + 0.97 * ring.radius_m * circle @ basis.T)
        columns, rows = np.rint(at).astype(int).T
        seen = np.abs(image[rows, columns] - without[rows, columns]) < 0.5
        assert np.mean(seen) == pytest.approx(1.0 / 3.0, abs=0.05)


def test_the_same_seed_draws_the_same_frame():
    options = RingSceneOptions(clutter=3, border=0.5, width_px=(80.0, 150.0))
    pictures = []
    for _ in range(2):
        rng = np.random.default_rng(7)
        pictures.append(render_ring_frame(random_scene(CAMERA, rng, options), rng))
    np.testing.assert_array_equal(*pictures)
    assert pictures[0].dtype == np.uint8


def test_a_scene_without_a_ring_has_none():
    options = RingSceneOptions(without_ring=1.0, clutter=2)
    assert random_scene(CAMERA, np.random.default_rng(0), options).ring is None
